"""Importance splitting within a photon's history: weight windows, and the stack that its copies wait on.

Where the window's target weight is small, a heavy photon is split into copies that share its power; where it is large,
a light one plays Russian roulette (Booth and Hendricks 1984). Copies wait on a stack of the lane's own and are walked
one after the other with the photon's one random stream, so that a history depends on (seed, stream, photon) alone.
The expected power of every state is conserved whatever the targets: they decide on noise and time, never on the mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import drjit as dr
import mitsuba as mi

from disco_twin.light.opaque import Opaque
from disco_twin.light.sampling import Rng
from disco_twin.light.tables import Tables, surroundings

CAPACITY = 24  # states that wait; a photon that finds the stack full is not split
MOST_COPIES = 8  # of one split
PLAIN_TARGET = 0.2  # of a launched photon's power, without a window: roulette alone

Part = Literal["plain", "split"]


class Window(Opaque):
    """Target weights, as shares of a launched photon's usual power, on maps of cells around the object.

    target: Float, per map `cells`^3 values; maps: UInt32 per tag, the number of its map. part: of images that plain and
    split walks make together, whose this walk is (`counted`), plain: how many of those there are to each split one.
    """

    target: Any
    maps: Any
    cells: int
    low: Any
    inverse_cell: Any
    part: Part | None
    plain: Any

    @property
    def splits(self) -> bool:
        """Whether photons are split."""
        return self.part != "plain"


def target_at(window: Window, tag: Any, p: Any) -> Any:
    """Target weight at p for the photons of a tag; the nearest cell's, clamped at the grid's rim."""
    cell = mi.Point3i(dr.floor((p - window.low) * window.inverse_cell))
    cell = dr.minimum(dr.maximum(cell, 0), window.cells - 1)
    number = dr.gather(mi.UInt32, window.maps, tag)
    index = mi.UInt32((cell.z * window.cells + cell.y) * window.cells + cell.x)
    return dr.gather(mi.Float, window.target, number * (window.cells**3) + index)


def counted(window: Window | None, tag: Any, p: Any) -> Any:
    """Share of what connects from p to the cameras that this walk counts; 1 unless it makes its images with another.

    The balance heuristic (Veach 1997, section 9.2.2) by the expected density of photons: of each split walk 1 / target
    to one of a plain walk. It depends on the place alone, and the shares of both parts add up to one, so the sum of
    their images is unbiased whatever the targets.
    """
    if window is None or window.part is None:
        return mi.Float(1.0)
    of_plain = window.plain * target_at(window, tag, p)
    return (of_plain if window.part == "plain" else 1.0) / (of_plain + 1.0)


@dataclass
class Stack:
    """States that wait: a block of floats each (see `state_size`), and how many copies of each are still to be walked.
    Loop state, unlike the tables: Dr.Jit follows what is written to it.
    """

    numbers: Any
    copies: Any
    depth: Any


def state_size(t: Tables, connects: bool) -> int:
    """Floats of a state: place, direction, power; the region, where there are several; and for connections to cameras
    the last collision, phase density and lobes.
    """
    return 6 + t.lasers + (t.walls is not None) + (5 if connects else 0)


def new_stack(t: Tables, connects: bool, lanes: int) -> Stack:
    """An empty stack for each lane."""
    numbers, copies = dr.alloc_local(mi.Float, CAPACITY * state_size(t, connects)), dr.alloc_local(mi.UInt32, CAPACITY)
    return Stack(numbers, copies, dr.zeros(mi.UInt32, lanes))


@dr.syntax
def resume(t: Tables, stack: Stack, photon: Any, running: Any, weight: Any, connects: bool) -> Any:
    """Lanes without a photon take a copy that waits. Returns (photon, stack)."""
    if dr.hint(running & ~photon.alive & (stack.depth > 0)):
        top, size = stack.depth - 1, state_size(t, connects)
        v = [stack.numbers.read(top * size + k) for k in range(size)]
        photon.p, photon.d, photon.w = mi.Point3f(*v[0:3]), mi.Vector3f(*v[3:6]), weight(*v[6 : 6 + t.lasers])
        if dr.hint(connects, mode="scalar"):
            photon.last, photon.phase, photon.lobes = mi.Point3f(*v[-5:-2]), v[-2], v[-1]
        if dr.hint(t.walls is not None, mode="scalar"):
            photon.region = mi.UInt32(v[6 + t.lasers])
        photon.empty, photon.rate = surroundings(t, photon.p, photon.region)
        photon.alive, photon.inside, photon.entered = mi.Bool(True), mi.Bool(True), mi.Bool(True)
        photon.clear, photon.steps = mi.Vector3f(0.0), mi.UInt32(0)
        left = stack.copies.read(top) - 1
        stack.copies.write(left, top)
        stack.depth = dr.select(left == 0, top, stack.depth)
    return photon, stack


@dr.syntax
def weigh(
    t: Tables, window: Any, stack: Any, photon: Any, first_tag: Any, inverse_scale: Any, sums: Any,
    rng: Rng, connects: bool,
) -> Any:  # fmt: skip
    """Bring the photon's power (the strongest wavelength's) to within a factor of two of the target where it is.

    Called when a flight has ended: to copy a photon whose flight has been drawn, but not what was drawn, would favour
    short flights. Nor is one at the surface, which still has to leave it. Returns (photon, stack, sums, rng).
    """
    if dr.hint(photon.alive & photon.inside & (dr.squared_norm(photon.clear) == 0.0)):
        target = mi.Float(PLAIN_TARGET)
        if dr.hint(stack is not None, mode="scalar"):
            target = target_at(window, first_tag + photon.tag, photon.p)
        ratio = dr.max(photon.w) * inverse_scale / target
        if dr.hint(ratio < 0.5):
            survives = rng.next() < ratio
            after = dr.select(survives, photon.w / ratio, 0.0)
            sums.roulette += type(sums.roulette)(after - photon.w)
            photon.w = after
            photon.alive = mi.Bool(survives)
        if dr.hint(stack is not None, mode="scalar"):
            if dr.hint((ratio >= 2.0) & (stack.depth < CAPACITY)):
                count = mi.UInt32(dr.minimum(ratio, MOST_COPIES))
                photon.w /= mi.Float(count)
                power = [photon.w[k] for k in range(t.lasers)]
                region = [] if t.walls is None else [mi.Float(photon.region)]
                values = [*photon.p, *photon.d, *power, *region, *photon.last, photon.phase, photon.lobes]
                size = state_size(t, connects)
                for k in range(size):
                    stack.numbers.write(values[k], stack.depth * size + k)
                stack.copies.write(count - 1, stack.depth)
                stack.depth += 1
    return photon, stack, sums, rng
