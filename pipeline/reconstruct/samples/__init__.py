"""From the stream to samples of R_d between laser spots and vertices."""
