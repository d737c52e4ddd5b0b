"""A virtual casting line: how registration and its bounds stand what castings differ by."""
