"""A Python in which the renderer cannot be imported."""

from __future__ import annotations

BLOCK = """
import sys
class NoRenderer:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("mitsuba", "drjit"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, NoRenderer())
"""
