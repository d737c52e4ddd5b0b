"""How alike virtual and real scans are, effect by effect, and a sensor fitted to the real ones."""
