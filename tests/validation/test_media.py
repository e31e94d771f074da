"""Media whose asymmetry varies from place to place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adding_doubling import Layer, Part, reflected_and_transmitted
from bumpy_twin import SPOT, VIEWS, blocks, bumpy
from significance import assert_z, z_of_difference, z_of_replicates
from twins import beam, block, camera

from disco_twin.light.transport import CameraLobe, Transport
from disco_twin.object.build import Medium, TwinBoundary, TwinObject

REPLICATES = 32
DEPTH = 1.2  # mm
SIGMA_T = np.array([3.0, 6.0, 2.0, 2.0])  # 1/mm, of voxels from below upwards
ALBEDO = np.array([[0.95, 0.8, 0.99, 0.9], [0.6, 0.99, 0.7, 0.95]])
ASYMMETRY = np.array([0.7, -0.4, 0.0, 0.7])


def interpolated(laser: int, layers: int = 120) -> list[Layer]:
    """The medium between the voxels' centres as thin layers, from the top down: linear in sigma_t and in what each
    voxel scatters.
    """
    found = []
    for k in range(layers):
        height = (layers - k - 0.5) / layers * len(SIGMA_T) - 0.5
        below = int(np.floor(height))
        shares = [(np.clip(i, 0, 3), w) for i, w in ((below, below + 1 - height), (below + 1, height - below))]
        parts = [Part(w * SIGMA_T[i] * ALBEDO[laser, i], ASYMMETRY[i]) for i, w in shares]
        found.append(Layer(DEPTH / layers, float(sum(w * SIGMA_T[i] for i, w in shares)), parts))
    return found


def layered() -> TwinObject:
    def column(values: np.ndarray) -> np.ndarray:
        return np.broadcast_to(values, (2, 4)).astype(np.float32)[:, :, None, None]

    mesh, g = block(30.0, DEPTH), column(ASYMMETRY)
    low, high = np.asarray(mesh.bounds, float)
    medium = Medium(column(SIGMA_T), column(ALBEDO), low, high, (0.1, 0.1), g)
    return TwinObject(mesh, TwinBoundary("matched", 1.0, 0.0), medium)


def test_adding_doubling_gives_known_answers() -> None:
    """van de Hulst's slab (g = .75, albedo .9, optical thickness 2), as one layer and as five."""
    for count in (1, 5):
        layers = [Layer(2.0 / count, 1.0, [Part(0.9, 0.75)])] * count
        assert reflected_and_transmitted(layers) == pytest.approx((0.09739, 0.66096), abs=1e-5)


def test_layers_of_different_asymmetry() -> None:
    """Rationale: forward, isotropic and backward scattering layers one upon another, albedos that differ by wavelength:
    whatever g a flight is given, collisions and absorption are the same.

    Expected behaviour: both wavelengths share a walk, whose reflection and transmission are those of discrete ordinates
    and adding, with the phase functions mixed between voxels as sigma_s is; z-scores from 32 replicates.
    """
    obj = layered()
    assert obj.medium.groups() == ((0, 1),)
    transport = Transport(obj, cells=64)
    traced = transport.trace(beam(REPLICATES), REPLICATES, 20_000, seed=81, deposit=True)
    assert traced.deposits is not None
    low = transport.vertices[:, 2] < -DEPTH / 2
    power = np.stack([traced.deposits[..., ~low].sum(axis=2), traced.deposits[..., low].sum(axis=2)], axis=2)
    exact = [reflected_and_transmitted(interpolated(laser)) for laser in (0, 1)]
    assert_z(z_of_replicates(power, exact), "R and T of both wavelengths")
    assert np.abs(traced.balance.residual).max() < 1e-6


@pytest.mark.parametrize("even", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_connections_know_the_asymmetry_at_the_collision(even: bool) -> None:
    """Rationale: a lobe connection scatters once more, by the phase function of the very voxel that was drawn.

    Expected behaviour: where voxels of g = .9 and -.7 lie side by side, images by lobes are those of plain exits, in
    every block of pixels and in total.
    """
    obj = bumpy()
    g = np.random.default_rng(5).choice(np.float32([0.9, -0.7]), obj.medium.sigma_t.shape)
    obj = replace(obj, medium=replace(obj.medium, g=(0.1,), g_voxels=g))
    views = [camera(place, 13.0, 24) for place in (VIEWS[:1] if even else VIEWS)]
    images = []
    for lobe, walks in ((None, 1_000), (CameraLobe(100.0, 0.0, 0.0), 6_000)):
        transport = Transport(obj, cells=64, lobe=lobe)
        key = {"seed": 82, "cameras": views, "even": even and lobe is None}
        traced = transport.trace(beam(REPLICATES, **SPOT), REPLICATES, walks, **key)
        assert traced.images is not None
        images.append(traced.images[:, 0, :, 0].astype(float))
    busy = blocks((images[1] > 0).mean(axis=0), 6) > 4
    assert busy.sum() > 10
    assert_z(z_of_difference(*[blocks(i, 6)[:, busy] for i in images]), "blocks")
    assert_z(z_of_difference(*[i.sum(axis=(-1, -2)) for i in images]), "cameras")
