"""Tables and pictures of an ablation."""
