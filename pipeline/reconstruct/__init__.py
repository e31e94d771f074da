"""Methods: from samples of R_d to a relightable model."""
