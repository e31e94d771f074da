"""What a reconstruction yields: a relightable model of the object, a sum of terms, and its file."""
