"""How often collisions of a small chance happen by the walk's random numbers. Needs an active renderer."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from disco_twin.light.sampling import Rng

LANES, ROUNDS = 1 << 20, 1 << 10


def counted(chance: float, fine: bool) -> int:
    """How many of LANES * ROUNDS uniform numbers lie below `chance`: of 32 bits (fine), or of 23."""
    rng = Rng.of(mi.UInt32(5), mi.UInt32(6), dr.arange(mi.UInt32, LANES))
    return int(np.array(_drawn(rng, dr.opaque(mi.Float, chance), fine), np.int64).sum())


def _draws(rng: Any, chance: Any, fine: bool) -> Any:
    found, k = dr.zeros(mi.UInt32, LANES), mi.UInt32(0)
    while dr.hint(k < ROUNDS, exclude=[fine]):
        u = rng.fine() if fine else rng.next()
        found += dr.select(u < chance, mi.UInt32(1), mi.UInt32(0))
        k += 1
    return found


_drawn: Any = dr.syntax(_draws)
