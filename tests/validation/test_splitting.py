"""Weight windows change noise and time, never the mean; what they are made from solves the diffusion equation."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from bumpy_twin import SPOT, VIEWS, blocks, bumpy
from half_spaces import HALF_SPACE, half_space
from numpy.typing import NDArray
from significance import assert_z, z_of_difference, z_of_replicates
from twins import beam, block, camera, escaped, twin

from disco_twin.light.importance import STEEPEST, Splitting, diffusion, window_targets
from disco_twin.light.sources import opaque3, to_float
from disco_twin.light.splitting import Window
from disco_twin.light.transport import CameraLobe, Transport

F64 = NDArray[np.float64]
REPLICATES = 32
ENTRY = np.tile(np.array(SPOT["origin"]) + 41.0 * np.array(SPOT["direction"]), (REPLICATES, 1))


@pytest.mark.parametrize(
    ("kind", "g"), [("rough", 0.0), pytest.param("rough", 0.8, marks=pytest.mark.slow), ("matched", 0.4)]
)
def test_splitting_is_unbiased(kind: str, g: float) -> None:
    """Rationale: a copy that forgets part of its photon's state (flight, last collision, power) moves energy.

    Expected behaviour: deposits at every vertex and images in every block of pixels equal those of the plain walk,
    z-scores from 32 replicates each, and dark vertices are less noisy.
    """
    obj = bumpy(kind, g=g)
    views = [camera(place, 13.0, 24) for place in VIEWS]
    transport = Transport(obj, cells=64)
    found = []
    for split, walks in ((None, 12_000), (Splitting(ENTRY, 4.0), 3_000)):
        key = {"seed": 81, "cameras": views, "layers": 2, "deposit": True, "split": split}
        traced = transport.trace(beam(REPLICATES, **SPOT), REPLICATES, walks, **key)  # type: ignore[arg-type]
        assert traced.images is not None
        assert traced.deposits is not None
        found.append((blocks(traced.images[:, 0, :, 0].astype(float), 6), traced.deposits[:, 0], walks))
    (plain, there, many), (split_images, here, few) = found
    lit = blocks((traced.images[:, 0, :, 0] > 0).mean(axis=0), 6) > 8
    assert lit.sum() > 15
    assert_z(z_of_difference(split_images[:, lit], plain[:, lit]), f"{kind}, g = {g}: blocks")
    order = np.argsort(-np.linalg.norm(transport.vertices - ENTRY[0], axis=1))  # not by what was found: that selects
    groups = np.array_split(order, 40)  # from far, dark to near
    grouped = [np.stack([d[:, i].sum(axis=1) for i in groups], axis=1) for d in (here, there)]
    assert_z(z_of_difference(*grouped), f"{kind}, g = {g}: deposits")
    dark = groups[0]
    assert here[:, dark].var(axis=0).sum() * few < 0.25 * there[:, dark].var(axis=0).sum() * many


@pytest.mark.parametrize(("kind", "g"), [("rough", 0.0), pytest.param("matched", 0.4, marks=pytest.mark.slow)])
def test_plain_and_split_walks_make_one_image(kind: str, g: float) -> None:
    """Rationale: each counts what it connects by a share that depends on the place; a share that differs between the
    two techniques of a path, or does not add up to one, moves energy.

    Expected behaviour: their sum equals the plain walk's images, by decade of light in each camera and block by block;
    both with the windows that are used and with targets drawn at random. Each alone shows less.
    """
    views = [camera(place, 13.0, 24) for place in VIEWS]
    transport = Transport(bumpy(kind, g=g), cells=64)

    def seen(walks: int, seed: int, split: Splitting | None = None) -> F64:
        source = beam(REPLICATES, **SPOT)  # type: ignore[arg-type]
        traced = transport.trace(source, REPLICATES, walks, seed=seed, cameras=views, split=split)
        assert traced.images is not None
        return np.asarray(traced.images[:, 0, :, 0], float)

    whole = seen(12_000, 87)
    for targets in ("made", "random"):
        if targets == "random":
            random_window(transport, -7.0, 7.0, (-1.5, 0.0))
        parts = {
            "plain": seen(6_000, 88, Splitting(ENTRY, 4.0, "plain", 4.0)),
            "split": seen(1_500, 89, Splitting(ENTRY, 4.0, "split", 4.0)),
        }
        joined = parts["plain"] + parts["split"]
        assert 0.05 < parts["split"].sum() / joined.sum() < 0.95
        busy = blocks((whole > 0).mean(axis=0), 6) > 8
        assert busy.sum() > 15
        cut = [blocks(image, 6)[:, busy] for image in (whole, joined)]
        assert_z(z_of_difference(*cut), f"{kind}, {targets}: blocks")
        level = whole[::2].mean(axis=0) / whole[::2].mean(axis=0).max()  # not of those that are compared: that selects
        for decade in range(3):
            part_of = (level <= 10.0**-decade) & (level > 10.0 ** -(decade + 1))
            sums = [np.where(part_of, image, 0.0).sum(axis=(-1, -2)) for image in (whole[1::2], joined)]
            assert_z(z_of_difference(*sums), f"{kind}, {targets}: decade -{decade}")


def random_window(transport: Transport, low: float, high: float, exponents: tuple[float, float]) -> None:
    """Let every trace with windows use targets drawn at random, cell by cell, on the cube from `low` to `high` mm."""
    cells = 24
    targets = 10 ** np.random.default_rng(3).uniform(*exponents, cells**3)

    def window(_: object, split: Splitting, __: int) -> Window:
        return Window(
            target=to_float(targets),
            maps=dr.zeros(mi.UInt32, REPLICATES),
            cells=cells,
            low=opaque3(mi.Point3f, np.full(3, low)),
            inverse_cell=dr.opaque(mi.Float, cells / (high - low)),
            part=split.part,
            plain=dr.opaque(mi.Float, split.plain),
        )

    transport._window = window  # type: ignore[method-assign]


def test_any_map_is_unbiased() -> None:
    """Rationale: the windows' targets must not matter for the mean, whatever they are.

    Expected behaviour: with targets drawn at random over three decades, the exact reflectance of a half-space, and
    launched power is accounted for.
    """
    transport = Transport(half_space(1.3, (0.9, 0.99, 0.999)))
    random_window(transport, -4.0, 4.0, (-2.0, 0.7))
    make = beam(REPLICATES)
    traced = transport.trace(make, REPLICATES, 4_000, seed=82, deposit=True, split=Splitting(np.zeros((REPLICATES, 3))))
    assert traced.deposits is not None
    assert_z(z_of_replicates(traced.deposits.sum(axis=2), HALF_SPACE[1.3][:3]))
    assert np.abs(traced.balance.residual).max() < 1e-5


def test_copies_remember_their_last_collision() -> None:
    """Rationale: an exit shares its path with the lobe connection of the flight's last collision; a copy that forgot it
    would count both in full.

    Expected behaviour: images of a body whose photons are split at random everywhere, in total those of plain exits.
    """
    obj = bumpy(g=0.8)  # lobes and flights often point the same way
    views = [camera(place, 13.0, 24) for place in VIEWS]
    totals = []
    for lobe, split, walks in ((None, Splitting(ENTRY), 2_000), (CameraLobe(100.0, 0.0, 0.0), None, 12_000)):
        transport = Transport(obj, cells=64, lobe=lobe)
        random_window(transport, -7.0, 7.0, (-2.0, -0.5))
        traced = transport.trace(beam(REPLICATES, **SPOT), REPLICATES, walks, seed=86, cameras=views, split=split)
        assert traced.images is not None
        totals.append(traced.images[:, 0, :, 0].astype(float).sum(axis=(-1, -2)))
    assert_z(z_of_difference(*totals), "cameras")


def test_half_space_with_windows() -> None:
    """The known reflectances, with the windows that are used."""
    transport = Transport(half_space(1.5, (0.9, 0.99, 0.999)))
    split = Splitting(np.tile([0.37, -0.21, 0.0], (REPLICATES, 1)))
    traced = transport.trace(beam(REPLICATES), REPLICATES, 4_000, seed=83, deposit=True, split=split)
    assert traced.deposits is not None
    assert_z(z_of_replicates(traced.deposits.sum(axis=2), HALF_SPACE[1.5][:3]))


def test_fluence_solves_the_diffusion_equation() -> None:
    """Rationale: the estimate must fall with distance and absorption as light does, or windows waste time.

    Expected behaviour: far inside a large box the fluence of a point source is exp(-k r) / (4 pi D r), within 12 % on
    cells of half a decay length (finite volumes, three to seven cells from the source); a source's fluence at another
    place is the other's at the first (reciprocity), exactly.
    """
    sigma_t, albedo = 1.0, 0.98
    obj = twin(block(60.0, 60.0), "matched", 1.0, sigma_t, [albedo])
    d, k = 1 / (3 * sigma_t), math.sqrt(3 * (1 - albedo))
    estimate = diffusion(obj, 0, cells=30)
    middle = estimate.low + (np.array([16, 16, 16]) + 0.5) * estimate.cell
    fluence = estimate.fluence(middle[None])[0]
    for steps in (3, 5, 7):
        r = steps * estimate.cell
        exact = math.exp(-k * r) / (4 * math.pi * d * r)
        assert fluence[16, 16, 16 + steps] == pytest.approx(exact, rel=0.12), steps
    other = estimate.low + (np.array([20, 10, 5]) + 0.5) * estimate.cell
    assert estimate.fluence(other[None])[0][16, 16, 16] == pytest.approx(fluence[5, 10, 20], rel=1e-9)


def test_effort_ends_where_the_light_is_darkest() -> None:
    """Rationale: a large dark body, whose fluence falls by 15 to 20 decades. Down to 1e-5 of the peak photons are to be
    as dense as in the light; where nothing was asked for they must not take the effort.

    Expected behaviour: collisions in cells whose light is split at all are equal within the targets' steps down to 1e-5
    (a limit at 1e-3 leaves a factor of a hundred), and those below 3e-6 are less than a third of all
    (without a limit two thirds to nine tenths of the effort goes there), and still fainter cells are met the less.
    """
    body = {albedo: twin(block(60.0, 60.0), "matched", 1.0, 1.0, [albedo]) for albedo in (0.9, 0.95)}
    estimates = {albedo: diffusion(obj, 0, cells=24) for albedo, obj in body.items()}
    for albedo, effort in ((0.9, 3.0), (0.9, 30.0), (0.95, 3.0)):
        estimate = estimates[albedo]
        fluence = estimate.fluence([[0.0, 0.0, -1.0]])
        target = window_targets(fluence, estimate.filled, effort)[0][estimate.filled]
        light = fluence[0][estimate.filled]
        met, share = light / target, light / light.max()
        assert share.min() < 1e-14
        split = (share > 1e-5) & (target < 1)
        assert split.sum() > 500
        assert met[split].max() / met[split].min() < 1.3
        assert met[share < 3e-6].sum() < met.sum() / 3
        assert met[share < 1e-9].max() < 0.01 * met[split].min()


def test_targets_spend_the_effort() -> None:
    """Expected: sum of max(fluence, f) = effort * sum of fluence over the filled cells, targets = min(1, fluence / f);
    an effort that is out of reach evens everything out; no cell is far below its neighbours.
    """
    random = np.random.default_rng(7)
    fluence = 10 ** random.uniform(-6, 0, (2, 9, 9, 9))
    fluence[:] = np.sort(fluence.reshape(2, -1), axis=1).reshape(fluence.shape)  # smooth enough along x
    filled = np.ones((9, 9, 9), bool)
    for effort in (1.0, 1.5, 4.0):
        targets = window_targets(fluence, filled, effort)
        for values, target in zip(fluence, targets, strict=True):
            level = (values / target)[target < 1].max() if (target < 1).any() else values.min()
            met = np.maximum(values, level).sum() / values.sum()
            assert met == pytest.approx(effort, rel=0.2)  # targets come in steps of a quarter octave
    assert window_targets(fluence, filled, 1e9)[0].min() < 1e-4
    hole = np.ones((1, 9, 9, 9))
    hole[0, 4, 4, 4] = 1e-12
    assert window_targets(hole, filled, 1e3).min() == pytest.approx(1 / STEEPEST)


def test_a_thin_plate_has_windows_too() -> None:
    """An object thinner than the diffusion's cells: the estimate is poor, the walk right."""
    mesh = trimesh.creation.box(extents=[20.0, 20.0, 0.2])
    obj = twin(mesh, "matched", 1.0, 2.0, [0.9])
    transport = Transport(obj)
    plain, _ = escaped(transport, beam(REPLICATES, origin=(0.3, 0.2, 5.0)), REPLICATES, 4_000, seed=84)
    split = Splitting(np.tile([0.3, 0.2, 0.1], (REPLICATES, 1)))
    make = beam(REPLICATES, origin=(0.3, 0.2, 5.0))
    traced = transport.trace(make, REPLICATES, 4_000, seed=85, deposit=True, split=split)
    assert traced.deposits is not None
    assert_z(z_of_difference(traced.deposits.sum(axis=2), plain), "plate")
