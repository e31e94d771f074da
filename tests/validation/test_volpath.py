"""Our walk against Mitsuba's own volumetric path tracer on a small scene.

Rationale: `volpath` starts at the camera, samples free flights and connects to emitters by different code. Both must
converge to the same image, block by block. Its Russian roulette is off (rr_depth = max_depth): with it, and albedo near
one, volpath is wrong (it caps survival at .95 on every iteration).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from significance import assert_z, z_of_difference

from benchmarks.volpath import volpath_scene
from disco_twin.light.rendering import from_light, from_pixels
from disco_twin.light.transport import Transport
from disco_twin.object.build import Medium, TwinBoundary, TwinObject, build_object
from disco_twin.scene.scene import load_scene
from pipeline.geometry.camera import PinholeCamera, look_at
from pipeline.relight.lights import Directional, Uniform

BLOCK, PIXELS = 4, 24


def bumpy(boundary: TwinBoundary, heterogeneous: bool) -> TwinObject:
    """A dented ball of about 10 mm, some four to twelve free paths across; the albedo is constant, so that Mitsuba's
    interpolation (of sigma_t and albedo) and ours (of sigma_t and sigma_s) mean the same medium.
    """
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    x, y, z = ball.vertices.T
    dent = np.exp(-((x - 0.7) ** 2 + y**2 + (z - 0.6) ** 2) / 0.2)
    radius = 5 * (1 + 0.12 * np.sin(3 * x + 1) * np.cos(2.5 * y) - 0.25 * dent)
    mesh = trimesh.Trimesh(ball.vertices * radius[:, None], ball.faces, process=False)
    low, high = mesh.bounds[0] - 0.1, mesh.bounds[1] + 0.1
    shape = (6, 7, 8) if heterogeneous else (1, 1, 1)
    sigma_t = np.random.default_rng(5).uniform(0.4, 1.6, shape) if heterogeneous else np.full(shape, 1.0)
    albedo = np.full(shape, 0.92)
    medium = Medium(sigma_t[None].astype(np.float32), albedo[None].astype(np.float32), low, high, (0.3,))
    return TwinObject(mesh, boundary, medium)


def camera_of() -> PinholeCamera:
    pose = look_at((90.0, 25.0, 40.0), (0.0, 0.0, 0.0))
    return PinholeCamera(PIXELS, PIXELS, np.array([175.0, 175.0]), np.full(2, PIXELS / 2), np.zeros(5), pose)


def volpath_images(
    obj: TwinObject, camera: PinholeCamera, light: Directional | Uniform, folder: Path, passes: int, spp: int
) -> np.ndarray:
    """(passes, H, W) independent renders by stock volpath of the light that the object sends to the camera; uniform
    light is met where paths leave, as in the outside references that ship.
    """
    scene = volpath_scene(obj, camera, light, folder, connect=not isinstance(light, Uniform))
    images = [np.array(mi.render(scene, spp=spp, seed=seed))[..., 0] for seed in range(passes)]
    return np.stack(images).astype(np.float64)


def blocks(images: np.ndarray) -> np.ndarray:
    """(..., H, W) -> (..., number of blocks) means."""
    n = PIXELS // BLOCK
    return images.reshape(*images.shape[:-2], n, BLOCK, n, BLOCK).mean(axis=(-3, -1)).reshape(*images.shape[:-2], -1)


CASES = [
    pytest.param(TwinBoundary("rough", 1.3, 0.3), False, "uniform", id="rough-homogeneous-uniform"),
    pytest.param(TwinBoundary("rough", 1.5, 0.4), True, "directional", id="rough-heterogeneous-directional"),
    pytest.param(
        TwinBoundary("matched", 1.0, 0.0), True, "directional", id="matched-heterogeneous", marks=pytest.mark.slow
    ),
]


@pytest.mark.parametrize(("boundary", "heterogeneous", "kind"), CASES)
def test_agrees_with_stock_volpath(boundary: TwinBoundary, heterogeneous: bool, kind: str, tmp_path: Path) -> None:
    """Expected: the same radiance in every 4 x 4 block, surface reflection included, within both sides' noise; so too
    the light from below the surface alone, which is volpath's image less that of the same object, black inside.
    """
    obj, camera = bumpy(boundary, heterogeneous), camera_of()
    light = Uniform() if kind == "uniform" else Directional(direction=(-0.7, 0.5, -0.5))
    transport = Transport(obj, cells=64)
    passes = 16
    spp = 128 if kind == "uniform" else 192
    theirs = blocks(volpath_images(obj, camera, light, tmp_path, passes, spp))
    if isinstance(light, Uniform):
        render, walks = from_pixels(transport, light, camera, 0.1, 7), 250
    else:
        render, walks = from_light(transport, light, camera, 7), 100_000
    layers = [render(walks, run)[:, :, 0] for run in range(passes // 2)]
    below, reflected = np.moveaxis(blocks(np.concatenate(layers).astype(np.float64)), 1, 0)
    ours = below + reflected
    seen = (ours > 0).all(axis=0) & (theirs > 0).all(axis=0)  # not the background
    assert seen.sum() >= 12
    assert_z(z_of_difference(ours[:, seen], theirs[:, seen]), "blocks")
    assert_z(z_of_difference(ours.mean(axis=1), theirs.mean(axis=1)), "whole image")
    black = replace(obj.medium, sigma_t=obj.medium.sigma_t * 100, albedo=obj.medium.albedo * 0)
    enough = 4 if boundary.kind == "matched" else spp  # there is none to be seen
    shine = blocks(volpath_images(replace(obj, medium=black), camera, light, tmp_path, passes, enough))
    assert_z(z_of_difference(below[:, seen], (theirs - shine)[:, seen]), "light from below the surface")
    if boundary.kind == "matched":
        assert not shine.any()
        assert not reflected.any()
    else:
        shiny = (shine > 0).sum(axis=0) > passes // 2
        assert_z(z_of_difference(reflected[:, seen & shiny], shine[:, seen & shiny]), "light reflected at the surface")


@pytest.mark.slow
def test_the_quick_scene_agrees_with_stock_volpath(repository: Path, tmp_path: Path) -> None:
    """Rationale: the references that ship come from the walk's lobe connections; this is the object that they show.

    Expected behaviour: under directional light, from the first held-out view, the same radiance in every block and in
    the whole image (red laser, surface reflection included), within both sides' noise.
    """
    scene = load_scene(repository / "scenes" / "quick.toml", faults=False)
    whole = build_object(scene)
    m = whole.medium
    obj = TwinObject(whole.mesh, whole.boundary, Medium(m.sigma_t[:1], m.albedo[:1], m.low, m.high, m.g[:1]))
    seen_by = PinholeCamera.from_config(scene.relight.views[0])
    focal, middle = np.full(2, seen_by.focal[0] / 6), np.full(2, PIXELS / 2)
    view = PinholeCamera(PIXELS, PIXELS, focal, middle, np.zeros(5), seen_by.pose)
    light = Directional(direction=next(x for x in scene.relight.lights if x.name == "directional").direction)
    theirs = blocks(volpath_images(obj, view, light, tmp_path, 16, 16))
    transport = Transport(obj)
    render = from_light(transport, light, view, 7)
    traced = [render(50_000, run).sum(axis=1)[:, 0] for run in range(8)]
    ours = blocks(np.concatenate(traced).astype(np.float64))
    lit = (ours > 0).all(axis=0) & (theirs > 0).all(axis=0)
    assert lit.sum() >= 12
    assert_z(z_of_difference(ours[:, lit], theirs[:, lit]), "blocks")
    assert_z(z_of_difference(ours.mean(axis=1), theirs.mean(axis=1)), "whole image")
