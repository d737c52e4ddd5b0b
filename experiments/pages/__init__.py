"""Pages and tables made from the recorded results."""
