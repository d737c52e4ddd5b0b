"""RPM-Net trained on generic shapes against RPM-Net trained on virtual scans (paper, Figs 8, 9)."""
