"""What is wrong with the actual rig: set-up errors, drift, speckle. The pipeline is given none of it."""
