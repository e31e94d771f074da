"""From images to a relightable model: capture, calibrate, reconstruct, relight."""
