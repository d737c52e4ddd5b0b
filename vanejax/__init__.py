"""Virtual scans of guide vanes, learned registration in JAX, and a pose to trust."""
