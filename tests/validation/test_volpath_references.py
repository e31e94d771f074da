"""References that ship, against images of the same lights and views by stock Mitsuba, committed beside them.

Rationale: all of our images, captures and truth alike, come from one kernel; an error of it would go unnoticed in
scores. `volpath` shares nothing with it but the mesh, the medium's tables and the rough boundary's model, and starts at
the camera. Its images are too dear for a test, so they are committed with what makes them
(benchmarks/volpath_references.py); here they are compared, block by block, with the noise of both.
"""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from significance import assert_z

from benchmarks.block_z import z_of_blocks
from benchmarks.volpath import FINER, emitter, parted
from benchmarks.volpath_references import Job, comparisons, jobs
from disco_twin.light.references import LAYERS, Reference, load_reference, noise_of
from disco_twin.light.rendering import from_pixels
from disco_twin.light.sources import sky_source
from disco_twin.light.transport import Transport
from pipeline.geometry.camera import PinholeCamera
from pipeline.relight.lights import Environment, Lobe

MUCH_NOISE = 0.1
JOBS = list(jobs())
IDS = [job.name.replace(" ", "-") for job in JOBS]


@pytest.fixture(params=JOBS, ids=IDS)
def job(request: pytest.FixtureRequest) -> Job:
    chosen: Job = request.param
    return chosen


def summed(reference: Reference) -> np.ndarray:
    """(2, L, H, W) halves of all light that the object sends to the camera."""
    return reference.halves.astype(np.float64).sum(axis=1)


def test_it_belongs_to_the_scene(job: Job) -> None:
    """Expected: made of this very object, light and view, three lasers, with a known noise."""
    theirs = load_reference(job.path)
    assert theirs.key == job.key
    assert theirs.halves.shape == job.ours().halves.shape
    assert theirs.noise == pytest.approx(noise_of(theirs.halves), rel=0.01)


def test_ours_agrees(job: Job) -> None:
    """Expected: within both sides' noise the same radiance in every block and in the whole image: all light, what comes
    from below, what the surface reflects. And the noise is what it is taken for.

    Of an image with much noise what the surface reflects is left out: few samples have met the lobes there, and where
    they did not the sum and its variance are low together (docs/decisions/0113).
    """
    found = comparisons(job)
    if load_reference(job.path).noise > MUCH_NOISE:
        del found["surface"]
    for name, z in found.items():
        assert z.blocks.shape[1] > 80
        assert_z(z.blocks, f"{name}, blocks")
        assert_z(z.whole, f"{name}, whole image")
        assert 0.8 < np.sqrt((z.blocks**2).mean()) < 1.25, name


def test_what_is_wrong_is_found(job: Job) -> None:
    """Expected: the same images, ours two per cent brighter, a pixel to the side, flipped, or with lasers exchanged, do
    not agree, by more than any threshold.
    """
    ours, theirs = summed(job.ours()), summed(load_reference(job.path))
    assert np.abs(z_of_blocks(1.02 * ours, theirs).whole).min() > 5
    for wrong in (np.roll(ours, 1, axis=-1), ours[..., ::-1], ours[..., ::-1, :]):
        assert np.abs(z_of_blocks(wrong, theirs).blocks).max() > 6
    assert np.abs(z_of_blocks(ours[:, ::-1], theirs).whole).max() > 6


@pytest.mark.parametrize(("eta", "right"), [(1.6, True), (1.55, False)])
def test_another_index_is_found(eta: float, right: bool) -> None:
    """Expected: the bracket rendered anew, from few walks, agrees; with an index that is .05 lower it does not."""
    job = next(job for job in JOBS if (job.scene.name, job.light.name) == ("bracket", "uniform"))
    obj = replace(job.obj, boundary=replace(job.obj.boundary, eta=eta))
    render = from_pixels(Transport(obj, cells=64), job.light, PinholeCamera.from_config(job.view), 0.1, 5)
    ours, theirs = render(16, 0).astype(np.float64), load_reference(job.path).halves.astype(np.float64)
    z = {name: z_of_blocks(ours[:, k], theirs[:, k]) for k, name in enumerate(LAYERS)}
    for layer, own in z.items():
        if right:
            assert_z(own.blocks, f"{layer}, blocks")
            assert_z(own.whole, f"{layer}, whole image")
        else:
            assert np.abs(own.whole).min() > 6, layer


def test_the_environment_is_where_ours_is() -> None:
    """Expected: Mitsuba's emitter has our light's radiance in every direction, to a ten-thousandth of the peak."""
    lobes = (
        Lobe(direction=(1.0, -2.0, 0.5), sharpness=20.0, radiance=(6.0, 5.0, 4.0)),
        Lobe(direction=(-0.3, 0.2, -1.0), sharpness=4.0, radiance=(0.6, 0.9, 1.4)),
    )
    light = Environment(constant=(0.15, 0.2, 0.3), lobes=lobes)
    towards = np.random.default_rng(3).normal(size=(20_000, 3))
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    direction = mi.Vector3f(np.ascontiguousarray(towards.T, np.float32))
    there = mi.SurfaceInteraction3f()
    there.wi = -direction
    theirs = np.array(mi.load_dict(emitter(light)).eval(there)).ravel()
    ours = np.array(sky_source(light, 1.0, [0]).radiance(direction)).ravel()
    assert theirs.shape == ours.shape == (len(towards),)
    assert np.abs(theirs - ours).max() < 1e-4 * 6.0


def test_finer_voxels_hold_the_same_field() -> None:
    """Expected: linear interpolation between the finer voxels gives what it gives between the old ones, at any place
    between their centres and outside.
    """
    random = np.random.default_rng(4)
    coarse = random.uniform(size=(5, 4, 6))
    place = random.uniform(-0.5, np.array(coarse.shape)[:, None] - 0.5, (3, 5000))  # in cells, from the first centre
    old = map_coordinates(coarse, place, order=1, mode="nearest")
    new = map_coordinates(parted(coarse), FINER * (place + 0.5) - 0.5, order=1, mode="nearest")
    np.testing.assert_allclose(new, old, atol=1e-12)
    assert parted(np.ones((1, 1, 1))).tolist() == np.ones((FINER,) * 3).tolist()
