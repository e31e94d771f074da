"""The scene file: what is simulated, captured, reconstructed and relit, as a strict schema."""
