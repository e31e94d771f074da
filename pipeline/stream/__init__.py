"""The stream: an append-only container of raw images with random access, and its lossless codec."""
