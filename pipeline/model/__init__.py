"""What a reconstruction yields: a relightable model of the object, and its file."""
