"""The object that light is traced through: shape, medium, and its scan."""
