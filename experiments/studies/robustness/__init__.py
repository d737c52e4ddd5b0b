"""How registration stands what happens at a machine: distance, angle, light, clutter, casting."""
