"""How well the verdict tells right poses from wrong ones, over parts and sensors."""
