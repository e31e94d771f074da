"""How a spot's time is shared among plain and split walks, and how long a walk takes. Needs no renderer.

Near the spot split walks show no more than plain ones and take longer; far from it they carry what plain walks hardly
reach. Where a scene asks for both they make a spot's images together (docs/decisions/0130).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from disco_twin.light.importance import Diffusion, window_targets
from disco_twin.object.build import TwinObject
from hw.base.arrays import F64

EFFORT, SPLIT_COST = 3.0, 4.5  # a split walk takes as long as so many plain ones of `quick`; in dense media longer
LIGHTEST = 0.01  # target weight below which copies, which are correlated, tell no more
# Processor seconds of a plain walk with cameras: of its start and of a collision (docs/decisions/0130).
START_S, COLLISION_S = 3.0e-6, 0.24e-6


@dataclass(frozen=True)
class SpotWalks:
    """How many walks a spot's images are made of."""

    plain: int
    split: int = 0

    @classmethod
    def of(cls, walks: int, split_share: float) -> SpotWalks:
        """Such that all take as long as `walks` plain ones, the split ones that share of the time."""
        split = round(split_share * walks / SPLIT_COST)
        return cls(max(1, round((1 - split_share) * walks)), split)


def walk_seconds(obj: TwinObject, collisions: float) -> float:
    """Seconds of a core for a plain walk of all wavelengths, each scattered so often (`Diffusion.collisions`)."""
    return len(obj.groups()) * (START_S + COLLISION_S * collisions)


def photon_density(estimate: Diffusion, fluence: F64, walks: SpotWalks) -> F64:
    """(N, n, n, n) photons that carry a launched one's power at each place, for spots of `fluence` (N, n, n, n)."""
    if not walks.split:
        return np.full_like(fluence, walks.plain)
    targets = np.maximum(window_targets(fluence, estimate.filled, EFFORT), LIGHTEST)
    return walks.plain + walks.split / targets
