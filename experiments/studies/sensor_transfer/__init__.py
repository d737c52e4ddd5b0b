"""What a network trained on virtual scans is worth on real ones."""
