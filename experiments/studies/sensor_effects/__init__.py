"""Every effect of the sensor alone: a picture to check by eye, and what it costs."""
