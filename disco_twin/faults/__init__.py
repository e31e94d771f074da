"""What is wrong with the actual rig: set-up errors, drift, speckle. The pipeline is told none of it."""
