"""Lights, what they send through the surface, and images of a model under them."""
