"""How a spot's time is shared among plain and split walks, and how long a walk takes. Needs no renderer.

Near the spot split walks show no more than plain ones and take longer; far from it they carry what plain walks hardly
reach. Both make a spot's images together (docs/decisions/0130).
"""

from __future__ import annotations

import numpy as np

from disco_twin.light.importance import Diffusion, window_targets
from disco_twin.object.build import TwinObject
from hw.base.arrays import F64

HALVES = 2  # of a spot's light, with random numbers of their own
SPLIT_SHARE = 0.4  # of a spot's time that split walks take
EFFORT, SPLIT_COST = 3.0, 3.7  # a split walk takes as long as so many plain ones
LIGHTEST = 0.01  # target weight below which copies, which are correlated, tell no more
# Processor seconds of a plain walk with cameras: of its start and of a collision (docs/decisions/0130).
START_S, COLLISION_S = 3.0e-6, 0.24e-6


def part_walks(walks: int) -> tuple[int, int]:
    """Plain and split walks of each half that together take as long as `walks` plain ones."""
    return max(1, round((1 - SPLIT_SHARE) * walks / HALVES)), max(1, round(SPLIT_SHARE * walks / SPLIT_COST / HALVES))


def walk_seconds(obj: TwinObject, collisions: float) -> float:
    """Seconds of a core for a plain walk of all wavelengths, each scattered so often (`Diffusion.collisions`)."""
    groups = len({(m.tobytes(), g) for m, g in zip(obj.medium.sigma_t, obj.medium.g, strict=True)})
    return groups * (START_S + COLLISION_S * collisions)


def photon_density(estimate: Diffusion, fluence: F64, walks: int) -> F64:
    """(N, n, n, n) photons that carry a launched one's power at each place, for spots of `fluence` (N, n, n, n)."""
    plain, split = part_walks(walks)
    targets = np.maximum(window_targets(fluence, estimate.filled, EFFORT), LIGHTEST)
    return HALVES * (plain + split / targets)
