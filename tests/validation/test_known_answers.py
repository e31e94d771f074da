"""Exact values of radiative transfer on the path that users run: mesh objects, the photon walk, tallies and cameras."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from half_spaces import HALF_SPACE, HFunction, half_space
from numpy.typing import NDArray
from significance import assert_z, z_of_replicates
from twins import beam, camera, escaped, pixel_areas

from disco_twin.light.transport import Transport
from disco_twin.object.build import TwinObject, build_object
from disco_twin.scene.scene import load_scene

F64 = NDArray[np.float64]
REPLICATES = 32


@pytest.mark.parametrize("n", [1.0, pytest.param(1.3, marks=pytest.mark.slow), 1.5])
def test_half_space(n: float) -> None:
    """Rationale: reflectance of a half-space with a smooth boundary, three albedos in one walk.

    Expected behaviour: the escaped share of the launched power is the exact value, z-scores from 32 replicates.
    The specular part is launched power that never entered, exactly Fresnel's.
    """
    transport = Transport(half_space(n, (0.9, 0.99, 0.999)))
    power, traced = escaped(transport, beam(REPLICATES), REPLICATES, 20_000, seed=11)
    assert_z(z_of_replicates(power, HALF_SPACE[n][:3]), f"n = {n}")
    specular, launches = ((n - 1) / (n + 1)) ** 2, REPLICATES * 20_000
    if n > 1:
        error = math.sqrt(specular * (1 - specular) / launches)
        assert_z((traced.balance.reflected[0] - specular) / error, "specular")
    else:
        assert np.all(traced.balance.reflected == 0)


@pytest.mark.slow
@pytest.mark.parametrize("n", [1.0, 1.3, 1.5])
def test_half_space_of_high_albedo(n: float) -> None:
    """As above for albedo .9999, whose light spreads over 60 free paths; a deeper block, three times the photons."""
    transport = Transport(half_space(n, (0.999, 0.9999), width=400.0, depth=150.0))
    power, _ = escaped(transport, beam(REPLICATES), REPLICATES, 60_000, seed=12)
    assert_z(z_of_replicates(power, HALF_SPACE[n][2:]), f"n = {n}")


def test_half_space_through_cameras() -> None:
    """Rationale: the camera path has its own geometry, connection, transmittance and radiometry.

    Expected behaviour: per watt of a narrow normal beam, the radiance towards direction mu summed over the surface is
    c / (4 pi) H(mu) H(1) / (1 + mu) (Chandrasekhar 1960, with the beam as mu_0 = 1), at each of three distant cameras
    and for each albedo; z-scores from 32 replicates.
    """
    albedo = (0.5, 0.9, 0.99)
    angles = np.radians([10.0, 45.0, 75.0])
    turns = np.radians([20.0, 140.0, 250.0])
    places = [
        3000 * np.array([math.sin(a) * math.cos(t), math.sin(a) * math.sin(t), math.cos(a)])
        for a, t in zip(angles, turns, strict=True)
    ]
    # The middle of the middle pixel looks at the beam, where most of the light is: areas are taken at pixel centres.
    views = [camera(place, 40.0, 15) for place in places]
    transport = Transport(half_space(1.0, albedo))
    make = beam(REPLICATES, origin=(0.02, -0.01, 50.0))
    traced = transport.trace(make, REPLICATES, 10_000, seed=13, cameras=views)
    assert traced.images is not None
    area = np.stack([pixel_areas(view) for view in views])
    summed = np.einsum("tclhw,chw->tcl", traced.images[:, 0].astype(float), area)
    mu = np.cos(angles)
    exact = [HFunction.of(c).seen(1.0, mu) for c in albedo]
    assert_z(z_of_replicates(summed, np.stack(exact, axis=1)), "cameras x albedos")


def slab(repository: Path) -> TwinObject:
    return build_object(load_scene(repository / "scenes" / "slab.toml"))


def sides(transport: Transport, replicates: int, walks: int, seed: int) -> F64:
    """(replicates, 2, L) power that left through the lit face (+x) and through the other one."""
    make = beam(replicates, origin=(50.0, 0.37, -0.21), direction=(-1.0, 0, 0))
    traced = transport.trace(make, replicates, walks, seed=seed, deposit=True)
    assert traced.deposits is not None
    lit = transport.vertices[:, 0] > 0
    return np.stack([traced.deposits[..., lit].sum(axis=2), traced.deposits[..., ~lit].sum(axis=2)], axis=1)


def test_slab(repository: Path) -> None:
    """Rationale: anisotropic scattering in a layer thinner than the distance field's cells, from the shipped scene.

    Expected behaviour: R = .09739 and T = .66096 (van de Hulst, g = .75, albedo .9, optical thickness 2).
    """
    power = sides(Transport(slab(repository)), REPLICATES, 20_000, seed=14)
    assert_z(z_of_replicates(power[:, :, 0], [0.09739, 0.66096]), "R and T")
    assert np.array_equal(power[:, :, 0], power[:, :, 1])  # equal wavelengths share a walk


def test_unscattered_light_of_the_slab(repository: Path) -> None:
    """With albedo 0 a share of exactly e^-2 passes, nothing comes back; the variance is the binomial one."""
    obj = slab(repository)
    medium = obj.medium
    black = type(medium)(medium.sigma_t, np.zeros_like(medium.albedo), medium.low, medium.high, medium.g)
    walks = 400_000
    reflected, through = sides(Transport(TwinObject(obj.mesh, obj.boundary, black)), 1, walks, seed=15)[0, :, 0]
    assert reflected == 0.0
    share = math.exp(-2)
    assert_z((through - share) / math.sqrt(share * (1 - share) / walks), "unscattered")
