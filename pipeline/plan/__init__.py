"""Which images a capture consists of: spots on the surface, calibration targets, and whether devices can see them."""
