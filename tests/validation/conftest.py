"""The validation tests run the renderer: it is chosen once, before anything imports drjit."""

from __future__ import annotations

from disco_twin.light.backend import activate

activate()
