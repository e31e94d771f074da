"""Same seed, same bits: whatever the batch, the lanes, the threads and the company.

Rationale: a resumed capture must equal an uninterrupted one bit for bit, on any number of cores.

Expected behaviour: images and deposits are equal, not merely close. The energy balance is summed in
double precision in an order that depends on the lanes, so it is equal up to rounding only.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from twins import camera

from disco_twin.light import sampling
from disco_twin.light import transport as module
from disco_twin.light.importance import Splitting
from disco_twin.light.sampling import Rng
from disco_twin.light.sources import BeamSource
from disco_twin.light.transport import Traced, Transport
from disco_twin.object.build import Medium, TwinBoundary, TwinObject

WALKS = 3000
SPOTS = 5
AXES = np.array([[0, 0, -1.0], [1, 0, 0], [0.6, 0, -0.8], [0, -1, 0], [0, 0.6, 0.8]])
NAMES = np.array([7, 4_000_000_000, 12, 3, 99], np.uint32)


def pebble(kind: str) -> Transport:
    """A bumpy, heterogeneous body: shared edges, grazing hits, shadows and null collisions all occur."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    x, y, z = mesh.vertices.T
    mesh.vertices *= (5 * (1 + 0.15 * np.sin(3 * x + 1) * np.cos(2.5 * y) + 0.1 * np.sin(4 * z)))[:, None]
    random = np.random.default_rng(1)
    shape = (3, 6, 5, 4)
    sigma_t = np.repeat(random.uniform(0.5, 3.0, (1, *shape[1:])), 3, axis=0).astype(np.float32)
    low, high = np.asarray(mesh.bounds, float)
    medium = Medium(sigma_t, random.uniform(0.9, 1.0, shape).astype(np.float32), low - 0.1, high + 0.1, (0.3,) * 3)
    eta = 1.0 if kind == "matched" else 1.3
    return Transport(TwinObject(mesh, TwinBoundary(kind, eta, 0.3 if kind == "rough" else 0.0), medium), cells=64)  # type: ignore[arg-type]


def spots(which: Sequence[int]) -> Any:
    axes = AXES[list(which)]

    def make(group: Sequence[int]) -> BeamSource:
        return BeamSource(-50 * axes, axes, 1.0, np.ones((len(axes), len(group))))

    return make


def trace(transport: Transport, which: Sequence[int] = range(SPOTS), **key: Any) -> Traced:
    views = [camera((300.0, 0.0, 80.0), 14.0, 24), camera((-200.0, 100.0, 250.0), 14.0, 24)]
    key |= {"streams": NAMES[list(which)], "cameras": views, "layers": 2, "deposit": True}
    return transport.trace(spots(which), len(which), WALKS, seed=61, **key)


def assert_same(a: Traced, b: Traced, part: slice | int = slice(None)) -> None:
    for name in ("images", "deposits"):
        one, other = getattr(a, name)[part], getattr(b, name)
        different = np.count_nonzero(one != other)
        assert different == 0, f"{different} of {other.size} {name} differ"
    for name in ("launched", "reflected", "escaped", "absorbed", "boundary"):
        if isinstance(part, slice):
            assert np.allclose(getattr(a.balance, name), getattr(b.balance, name), rtol=1e-9, atol=1e-12)


@pytest.fixture(scope="module", params=["rough", "matched"])
def usual(request: pytest.FixtureRequest) -> tuple[Transport, Traced]:
    transport = pebble(request.param)
    return transport, trace(transport)


@pytest.mark.parametrize("kind", ["rough", "matched"])
def test_splitting(kind: str, monkeypatch: pytest.MonkeyPatch, threads: int) -> None:
    """With weight windows: one spot at a time in calls of a few photons, other lanes and threads, another company."""
    transport = pebble(kind)
    entries = -4.5 * AXES

    def split(which: Sequence[int] = range(SPOTS)) -> Splitting:
        return Splitting(entries[list(which)], 3.0)

    expected = trace(transport, split=split())
    assert_same(expected, trace(transport, split=split(), lanes=1000))
    dr.set_thread_count(1)
    assert_same(expected, trace(transport, [3, 1], split=split([3, 1])), [3, 1])  # type: ignore[arg-type]
    monkeypatch.setattr(module, "ACCUMULATOR_BYTES", 1)
    monkeypatch.setattr(module, "PHOTONS_PER_CALL", 700)
    assert_same(expected, trace(transport, split=split()))


def test_batches(usual: tuple[Transport, Traced], monkeypatch: pytest.MonkeyPatch) -> None:
    """One spot at a time, and a few hundred photons a call."""
    transport, expected = usual
    monkeypatch.setattr(module, "ACCUMULATOR_BYTES", 1)
    assert_same(expected, trace(transport))
    monkeypatch.setattr(module, "PHOTONS_PER_CALL", 700)
    assert_same(expected, trace(transport))


@pytest.mark.parametrize("lanes", [1 << 12, 1 << 14, 1000])
def test_lanes(usual: tuple[Transport, Traced], lanes: int) -> None:
    """Fewer lanes than photons, more than photons, and a number that fills no vector register."""
    transport, expected = usual
    assert_same(expected, trace(transport, lanes=lanes))


@pytest.fixture
def threads() -> Iterator[int]:
    before = dr.thread_count()
    yield before
    dr.set_thread_count(before)


def test_threads(usual: tuple[Transport, Traced], threads: int) -> None:
    transport, expected = usual
    for count in (1, 2, 5):
        dr.set_thread_count(count)
        assert_same(expected, trace(transport))


def test_denormal_numbers_do_not_matter(threads: int) -> None:
    """Worker threads flush denormal numbers to zero, the calling thread does not: the rare draw u = 0 must not show it.

    Expected behaviour: a lobe direction drawn with u = 0 is the same in a small array (calling thread), in a large one
    with one thread (the same) and in a large one with workers.
    """
    cosines = []
    for count, size in ((1, 16), (1, 1 << 18), (2, 16), (2, 1 << 18)):
        dr.set_thread_count(count)
        rng = Rng(dr.zeros(mi.UInt32, size), dr.full(mi.UInt32, 5, size))
        direction = sampling.von_mises_fisher(rng, mi.Vector3f(0.0, 0.0, 1.0), dr.opaque(mi.Float, 100.0))
        cosines.append(float(direction.z[size // 2]))
    assert 0 < cosines[0] < 0.2
    assert cosines == [cosines[0]] * 4


def test_company(usual: tuple[Transport, Traced]) -> None:
    """A spot alone gives the image that it gives among others, in whatever order: its stream has a name of its own."""
    transport, expected = usual
    for k in range(SPOTS):
        assert_same(expected, trace(transport, [k]), k)
    assert_same(expected, trace(transport, [3, 1]), [3, 1])  # type: ignore[arg-type]


def test_a_continued_trace_adds_up(usual: tuple[Transport, Traced]) -> None:
    """Photons 0...1999 and then 2000...2999 are the photons 0...2999: deposits add up to the last count."""
    transport, _ = usual

    def deposits(first: int, walks: int) -> NDArray[np.float64]:
        traced = transport.trace(spots(range(SPOTS)), SPOTS, walks, seed=61, streams=NAMES, deposit=True, first=first)
        assert traced.deposits is not None
        return traced.deposits * walks

    together, apart = deposits(0, 3000), deposits(0, 2000) + deposits(2000, 1000)
    assert np.abs(together - apart).max() < 1e-12 * together.max()


def test_other_seeds_and_names_differ(usual: tuple[Transport, Traced]) -> None:
    """Another seed, or another stream of the same beam, gives other photons."""
    transport, expected = usual
    key = {"cameras": [camera((300.0, 0.0, 80.0), 14.0, 24)], "layers": 2}
    for seed, name in ((62, NAMES[0]), (61, NAMES[0] + 1)):
        other = transport.trace(spots([0]), 1, WALKS, seed=seed, streams=np.array([name], np.uint32), **key)
        assert other.images is not None
        assert expected.images is not None
        assert not np.array_equal(other.images[0, :, 0], expected.images[0, :, 0])
