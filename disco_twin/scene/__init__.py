"""The scene file: what is simulated, captured, reconstructed and relit, as a strict schema."""

from disco_twin.scene.scene import Scene, load_scene, shrink

__all__ = ["Scene", "load_scene", "shrink"]
