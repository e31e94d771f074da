"""The surface's reflection in the samples near the spots: found where it is, and left alone where it is not."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import trimesh
from reconstruct_synthetic import make

from disco_twin.camera.lars3 import lars3_sensor
from pipeline.calibrate.calibration import nominal_calibration
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.nominal_rig import CameraConfig, LaserConfig, RigConfig
from pipeline.reconstruct.omissions import omissions
from pipeline.reconstruct.samples.samples import Samples, SpotSumImage
from pipeline.reconstruct.samples.surface_lobe import BeamReadings, seen_by
from pipeline.reconstruct.surface_term import lobe_fit
from pipeline.reconstruct.surface_term.lobe_fit import fit_lobe, subtract_reflection


@lru_cache
def looked_at(noise: float = 0.03, spots: int = 120) -> Samples:
    """The sphere with spots that stand upright, seen by two cameras, one a spot."""
    s = make(subdivisions=2, spots=spots, noise=noise, contrast=0.1, hidden=0.0, lasers=2).samples
    views, parts = [], []
    lit = s.lit.tocoo()
    for view, towards in enumerate(np.array([[1.0, 0.3, 0.2], [-0.8, 0.6, 0.3]])):
        away = np.asarray(trimesh.geometry.align_vectors(-towards, [0, 0, 1]))
        away[2, 3] = 400.0
        camera = PinholeCamera(8, 8, np.array([90.0, 90.0]), np.array([4.0, 4.0]), np.zeros(5), away)
        facing = (s.spots.normal @ towards) / np.linalg.norm(towards) > 0.3
        views.append(SpotSumImage(camera, np.zeros((2, 8, 8)), np.broadcast_to(facing, (2, spots)).copy()))
        own = facing[lit.row] & (view == lit.row % 2)
        parts.append((lit.row[own], lit.col[own], np.full(own.sum(), view), np.ones(own.sum())))
    read = BeamReadings(*(np.concatenate(p) for p in zip(*parts, strict=True)))
    return s.with_readings(glow=tuple(views), read_in_beams=read)


def with_lobe(s: Samples, alpha: float, strength: float) -> Samples:
    """The samples with a reflection in them."""
    value = s.values.astype(np.float64)
    for laser in value:
        np.add.at(laser, (s.read_in_beams.spot, s.read_in_beams.vertex), strength * s.beams.in_samples(alpha))
    return s.with_readings(values=value.astype(np.float32))


@pytest.mark.parametrize(("alpha", "strength"), [(0.2, 2.0), (0.35, 3.0)])
def test_a_reflection_is_found_and_taken_off(alpha: float, strength: float) -> None:
    """Rationale: made by the same law, so that the fit is tried, not the law (tests/validation/test_microfacet.py)."""
    s = looked_at()
    bright = with_lobe(s, alpha, strength)
    found = fit_lobe(bright)
    assert not found.because
    assert abs(found.strength - strength) < 4 * found.error
    assert found.error < 0.5 * strength
    clean = subtract_reflection(bright)
    at = (slice(None), s.read_in_beams.spot, s.read_in_beams.vertex)
    added = (bright.values[at] - s.values[at]).sum()
    assert added > 0
    assert abs((clean.values[at] - s.values[at]).sum()) < 4 * found.error / strength * added
    untouched = np.ones(s.values.shape, bool)
    untouched[at] = False
    np.testing.assert_array_equal(clean.values[untouched], bright.values[untouched])
    assert (clean.dark_variance[at] >= bright.dark_variance[at]).all()
    assert (clean.dark_variance[at] > bright.dark_variance[at]).any()


@pytest.mark.slow
@pytest.mark.parametrize(("alpha", "strength", "scatter"), [(0.2, 2.0, 0.08), (0.3, 2.5, 0.05)])
def test_strengths_are_unbiased_with_honest_errors(
    alpha: float, strength: float, scatter: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rationale: what lies below a spot scatters by its own. Expected: a mean z-score of chance and an rms near 1."""
    monkeypatch.setattr(lobe_fit, "BY_CHANCE", 0.01)  # hardly any is left out: those would be the weak ones
    s, rng, z = looked_at(noise=0.0), np.random.default_rng(7), []
    at = s.read_in_beams
    for _ in range(16):
        own = np.exp(scatter * rng.standard_normal(len(s.spots.position)))
        value = s.values.astype(np.float64)
        value[:, at.spot, at.vertex] *= own[at.spot]
        found = fit_lobe(with_lobe(s.with_readings(values=value.astype(np.float32)), alpha, strength))
        if not found.because:
            z.append((found.strength - strength) / found.error)
    assert len(z) >= 12
    assert abs(np.mean(z)) < 4 / np.sqrt(len(z)) + 0.5  # half an error of bias is what the prior may pull
    assert 0.3 < np.sqrt(np.mean(np.square(z))) < 1.5


def test_no_reflection_is_taken_off_where_there_is_none() -> None:
    s = looked_at()
    left = subtract_reflection(s)
    assert left.lobe is not None and "mirror direction" in left.lobe.because
    np.testing.assert_array_equal(left.values, s.values)


@pytest.mark.slow
def test_false_alarms_are_as_rare_as_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rationale: noise alone, 40 times, with a limit that one in twenty exceeds. Expected: at most what chance allows
    (one-sided strengths make it rarer).
    """
    monkeypatch.setattr(lobe_fit, "BY_CHANCE", 0.05)
    monkeypatch.setattr(lobe_fit, "PROFILES", 1)
    s, rng = looked_at(noise=0.0, spots=100), np.random.default_rng(5)
    alarms = 0
    for _ in range(40):
        local = 1 + 0.08 * rng.standard_normal(len(s.spots.position))
        noisy = s.with_readings(values=(s.values * local[:, None]).astype(np.float32))
        near = noisy.values.copy()
        own = 1 + 0.08 * rng.standard_normal(len(local))
        near[:, s.read_in_beams.spot, s.read_in_beams.vertex] *= own[s.read_in_beams.spot].astype(np.float32)
        alarms += not fit_lobe(noisy.with_readings(values=near)).because
    assert alarms <= 7  # 40 x .05 = 2; more than 7 by chance in 1 of 1000


def test_too_few_spots_say_so() -> None:
    s = looked_at(spots=25)
    assert "30 are needed" in fit_lobe(s).because
    assert "0 spots were read" in fit_lobe(replace(s, read_in_beams=BeamReadings.none())).because


def test_a_matched_surface_reflects_nothing() -> None:
    left = subtract_reflection(looked_at().with_readings(eta=1.0))
    assert left.lobe is not None and "no light is reflected" in left.lobe.because


def test_a_camera_behind_the_surface_sees_no_lobe() -> None:
    s = looked_at()
    seen = seen_by(s.glow[0].camera, s.spots, s.eta, 0.3)
    towards = s.glow[0].camera.position - s.spots.position
    facing = (towards * s.spots.normal).sum(axis=1) > 0
    assert (seen[~facing] == 0).all()
    assert (seen[facing & (seen > 0)] > 0).any()


def test_what_is_left_out_is_said() -> None:
    camera = CameraConfig(name="one", position_mm=(0, 0, 400), width=16, height=16)
    rig = RigConfig(lasers=(LaserConfig(wavelength_nm=473), LaserConfig(wavelength_nm=638)), cameras=(camera,))
    nominal = nominal_calibration(rig, lars3_sensor(rig))
    rows = omissions(subtract_reflection(looked_at()), nominal)
    assert any(row["what"] == "the surface's reflection" for row in rows)
