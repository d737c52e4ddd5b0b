"""The guide vane from uniformly random rotations, without an initial guess."""
