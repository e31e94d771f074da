"""Diffusion inside the scan: what R_d would be if the medium were the same everywhere."""
