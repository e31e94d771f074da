"""The global term: R_d between all vertices, completed from samples at the spots."""
