"""Slips on purpose between a calibration and its samples: the samples' own score sees each of them.

The score is the root mean square of log(measured / true R_d) over a sphere whose R_d is known. A slip has to raise it
by the factor that stands beside it, over what the unbroken chain scores in the same test.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import reconstruct_capture
import trimesh
from numpy.typing import NDArray
from reconstruct_capture import ETA, RADIUS, SENSOR, reflectance, rig, write_capture

from hw.record import RawImage
from pipeline.calibrate.calibration import Calibration, nominal_calibration
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import transmittance
from pipeline.plan.plan import ImageAddress, Plan
from pipeline.reconstruct.samples import image_operators as views
from pipeline.reconstruct.samples import resample, samples, spots
from pipeline.reconstruct.samples.samples import take_samples
from pipeline.reconstruct.settings import ReconstructConfig
from pipeline.stream.stream import StreamReader

F64 = NDArray[np.float64]
FACTORS = (1.2, 0.9)  # of a camera that shows too little and too much: white balance is not one here

Patch = pytest.MonkeyPatch


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, trimesh.Trimesh]:
    folder = tmp_path_factory.mktemp("run") / "capture"
    return folder, write_capture(folder, 3)


def score(captured: tuple[Path, trimesh.Trimesh], **changes: float) -> float:
    """rms of log(measured / true) within 15 mm; nothing measured, or nothing positive, is as bad as can be."""
    folder, mesh = captured
    settings = ReconstructConfig(eta=ETA, **changes)
    nominal = nominal_calibration(rig(), SENSOR)
    balanced = tuple(v.model_copy(update={"radiance_factor": FACTORS}) for v in nominal.views)
    calibration = nominal.model_copy(update={"views": balanced})
    with StreamReader(folder) as stream:
        readings = [
            views.footprint_reading(mesh, calibration.view_camera(v), ETA, settings.max_view_deg)
            for v in range(stream.plan.views)
        ]
        taken, _ = take_samples(stream, calibration, mesh, {"it": readings}, settings)
    value, at = taken["it"].values, taken["it"].spots.position
    distance = np.linalg.norm(at[:, None] - mesh.vertices, axis=2)
    true = np.stack([reflectance(distance, k) * FACTORS[k] for k in range(2)])
    near = np.isfinite(value) & (distance < 15.0)
    if near.mean() < 0.05 or (value[near] <= 0).mean() > 0.2:
        return np.inf
    return float(np.sqrt((np.log(np.maximum(value, 1e-9) / true)[near] ** 2).mean()))


def pixels_moved(move: Callable[[F64, PinholeCamera], F64]) -> Callable[[Patch], None]:
    def slip(patch: Patch) -> None:
        rays = PinholeCamera.rays
        patch.setattr(PinholeCamera, "rays", lambda self, pixels: rays(self, move(np.asarray(pixels), self)))

    return slip


def transposed_pose(patch: Patch) -> None:
    rays = PinholeCamera.rays

    def broken(self: PinholeCamera, pixels: F64) -> tuple[F64, F64]:
        origins, directions = rays(self, pixels)
        return origins, directions @ self.pose[:3, :3].T @ self.pose[:3, :3].T

    patch.setattr(PinholeCamera, "rays", broken)


def towards_the_camera(patch: Patch) -> None:
    patch.setattr(views, "transmittance", lambda cosine, eta: np.ones_like(cosine))


def degrees_for_radians(patch: Patch) -> None:
    patch.setattr(
        views, "transmittance", lambda cosine, eta: transmittance(np.cos(np.rad2deg(np.arccos(cosine))), eta).clip(0.1)
    )


def towards_the_laser(patch: Patch) -> None:
    real = spots.transmittance
    patch.setattr(spots, "transmittance", lambda cosine, eta: real(cosine, eta) ** 2)


def exponent_of_the_wrong_sign(patch: Patch) -> None:
    real = resample.to_radiance
    patch.setattr(
        resample,
        "to_radiance",
        lambda raw, *more: real(RawImage(11 - raw.exponent.astype(np.uint8), raw.charge), *more),
    )


def no_offset(patch: Patch) -> None:
    real = resample.to_radiance
    patch.setattr(resample, "to_radiance", lambda raw, sensor, k: real(raw, replace(sensor, offset_dn=0.0), k))


def no_white_balance(patch: Patch) -> None:
    patch.setattr(Calibration, "factor", lambda *_: 1.0)


def window_shifted(pixels: int) -> Callable[[Patch], None]:
    def slip(patch: Patch) -> None:
        real = resample.ViewReader.of.__func__

        def broken(cls: type, *arguments: object) -> resample.ViewReader:
            sight = real(cls, *arguments)
            rows, columns = sight.window
            moved = slice(columns.start + pixels, columns.stop + pixels)
            return replace(sight, window=(rows, moved))

        patch.setattr(resample.ViewReader, "of", classmethod(broken))

    return slip


def rays_changed(change: Callable[[F64, F64], tuple[F64, F64]]) -> Callable[[Patch], None]:
    def slip(patch: Patch) -> None:
        real = Calibration.spot_rays
        patch.setattr(Calibration, "spot_rays", lambda self, aims: change(*real(self, aims)))

    return slip


def mirrors_swapped(patch: Patch) -> None:
    real = Calibration.spot_rays
    patch.setattr(Calibration, "spot_rays", lambda self, aims: real(self, [replace(a, u=a.v, v=a.u) for a in aims]))


SLIPS: dict[str, tuple[float, Callable[[Patch], None]]] = {
    "map: rows for columns": (20, pixels_moved(lambda p, c: p[:, ::-1] + c.centre - c.centre[::-1])),
    "map: down is up": (20, pixels_moved(lambda p, c: np.column_stack([p[:, 0], c.height - p[:, 1]]))),
    "map: half a pixel": (1.7, pixels_moved(lambda p, c: p + 0.5)),
    "map: pose transposed": (5, transposed_pose),
    "map: no transmittance to the camera": (1.5, towards_the_camera),
    "map: degrees for radians": (20, degrees_for_radians),
    "spots: transmittance squared": (1.5, towards_the_laser),
    "spots: mirrors swapped": (5, mirrors_swapped),
    "spots: turned the wrong way": (5, rays_changed(lambda o, d: (o * [1, -1, 1], d * [1, -1, 1]))),
    "resampling: exponent's sign": (20, exponent_of_the_wrong_sign),
    "resampling: no offset": (1.3, no_offset),
    "resampling: no white balance": (3, no_white_balance),
    "resampling: window beside": (5, window_shifted(3)),
}


@pytest.mark.parametrize("name", SLIPS)
def test_a_slip_shows_in_the_samples(
    name: str, captured: tuple[Path, trimesh.Trimesh], monkeypatch: pytest.MonkeyPatch
) -> None:
    good = score(captured)
    assert good < 0.05
    factor, slip = SLIPS[name]
    slip(monkeypatch)
    bad = score(captured)
    assert bad > factor * good


def test_highlights_are_masked_where_they_are(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rationale: a rough sphere mirrors the beam, within 18 degrees of the mirror direction and inside the beam, as
    brightly as it glows. Expected behaviour: a mask of 20 degrees leaves no trace of it; without it, or with
    the half vector's sign the wrong way round, the score rises by a third: three spots of 24 mirror into a camera.
    """
    real = reconstruct_capture.images

    def with_glint(calibration: Calibration, plan: Plan, address: ImageAddress) -> F64:
        out = real(calibration, plan, address)
        if address.kind == "silhouette":
            return out
        camera = calibration.view_camera(address.view)
        origins, directions = camera.rays(camera.pixel_centres())
        b = (origins * directions).sum(axis=1)
        along = -b - np.sqrt(np.maximum(b**2 - (origins**2).sum(axis=1) + RADIUS**2, 0))
        points = origins + along[:, None] * directions
        o, d = (x[0] for x in calibration.spot_rays([plan.spots[address.spot]]))
        half = -directions - d
        half /= np.linalg.norm(half, axis=1)[:, None]
        at = o + d * (-(o @ d) - np.sqrt((o @ d) ** 2 - o @ o + RADIUS**2))
        mirrored = (half * points / RADIUS).sum(axis=1) > np.cos(np.deg2rad(18.0))
        inside = np.linalg.norm(points - at, axis=1) < 2.0
        return np.asarray(out * np.where(mirrored & inside, 2.3, 1.0).reshape(out.shape))

    monkeypatch.setattr(reconstruct_capture, "images", with_glint)
    folder = tmp_path_factory.mktemp("glint") / "capture"
    glinting = folder, write_capture(folder, 3)
    good = score(glinting, highlight_deg=20.0)
    assert good < 0.05
    assert score(glinting, highlight_deg=0.0) > 1.3 * good
    real_highlights = samples.highlights

    def wrong_sign(spots: spots.Spots, *more: object) -> dict[tuple[int, int], NDArray[np.int64]]:
        return real_highlights(replace(spots, direction=-spots.direction), *more)  # type: ignore[arg-type]

    monkeypatch.setattr(samples, "highlights", wrong_sign)
    assert score(glinting, highlight_deg=20.0) > 1.3 * good
