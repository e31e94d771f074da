"""The stages of a run, from scene to scores, and what the user sees of them."""
