"""Fine registration against the Cramer-Rao bound, over views of the guide vane and noise levels."""
