"""The pipeline from a capture folder to relit images, on a sphere whose R_d is known; and its refusals."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import IO

import numpy as np
import pytest
from reconstruct_capture import ETA, RADIUS, SENSOR, reflectance, rig, write_capture

from hw.base.errors import InputError
from pipeline.calibrate.calibration import Calibration, nominal_calibration
from pipeline.geometry.fresnel import transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.mesh_file import read_scan
from pipeline.model.relightable import RelightableModel
from pipeline.reconstruct.global_term.boundary_fit import measure_boundary
from pipeline.reconstruct.methods import reconstruct
from pipeline.reconstruct.samples.image_operators import bilinear_reading, footprint_reading
from pipeline.reconstruct.samples.samples import take_samples
from pipeline.reconstruct.samples.samples_file import load_samples
from pipeline.reconstruct.settings import ReconstructConfig
from pipeline.run import Request, Stages, main, relight, run
from pipeline.stream.stream import StreamReader

METHODS = ("default", "disco2004", "dipole", "lambertian")


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory):  # type: ignore[no-untyped-def]
    folder = tmp_path_factory.mktemp("run") / "capture"
    return folder, write_capture(folder)


@pytest.fixture(scope="module")
def result(captured):  # type: ignore[no-untyped-def]
    folder, _ = captured
    view = rig().cameras[0].model_copy(update={"name": "held", "position_mm": (100.0, 380.0, 60.0)}).model_dump()
    request = Request.model_validate(
        {"format_version": 1, "relight": {"views": [view], "lights": [{"kind": "uniform", "colour": [1, 1, 1]}]}}
    )
    return folder.parent / "work", run(folder, folder.parent / "work", request)


def samples_of(folder: Path, mesh, reading, **settings):  # type: ignore[no-untyped-def]
    config = ReconstructConfig(**settings)
    calibration = nominal_calibration(rig(), SENSOR)
    readings = [reading(mesh, calibration.view_camera(v), config.eta, config.max_view_deg) for v in range(4)]
    with StreamReader(folder) as stream:
        taken, statistics = take_samples(stream, calibration, mesh, {"it": readings}, config)
    return taken["it"], statistics


@pytest.mark.parametrize(
    ("reading", "limit", "bias"), [(footprint_reading, 0.08, 0.025), (bilinear_reading, 0.07, 0.06)]
)
def test_samples_are_the_reflectance(captured, reading, limit: float, bias: float) -> None:  # type: ignore[no-untyped-def]
    """Rationale: images made from eq. 2.1 with a known R_d; power, Fresnel factors and vignetting must all cancel.

    What is left is the scan's flat triangles against the smooth sphere, and footprints that are seen in part.
    """
    folder, mesh = captured
    samples, statistics = samples_of(folder, mesh, reading)
    for laser in range(2):
        exact = samples.spot_pairs.mean(lambda d, k=laser: reflectance(d, k))
        seen = np.isfinite(samples.values[laser])
        error = np.log(samples.values[laser][seen] / exact[seen])
        assert np.sqrt((error**2).mean()) < limit
        assert abs(error.mean()) < bias  # a bilinear look-up does not average over the hat
    assert 0.5 < statistics.coverage < 1.0
    assert statistics.images == (24 - statistics.spots_too_oblique) * 2 * 2
    assert statistics.saturated_pixels == 0


def test_footprints_keep_a_constant(captured) -> None:  # type: ignore[no-untyped-def]
    """Rationale: a constant radiance is read as itself over F_t wherever a hat is seen, whatever the pixels."""
    _, mesh = captured
    camera = nominal_calibration(rig(), SENSOR).view_camera(0)
    reading = footprint_reading(mesh, camera, ETA, 75.0)
    seen = reading.share > 0.5
    assert seen.sum() > 30
    value = (reading.operator @ np.ones(96 * 80))[seen]
    np.testing.assert_allclose(value, 1 / transmittance(reading.cosine[seen], ETA), rtol=0.02)
    assert (reading.cosine[seen] > np.cos(np.deg2rad(75.0))).all()
    assert reading.operator[np.flatnonzero(reading.share == 0)].nnz == 0


def test_oblique_spots_are_counted_and_left_out(captured) -> None:  # type: ignore[no-untyped-def]
    folder, mesh = captured
    samples, statistics = samples_of(folder, mesh, footprint_reading, max_incidence_deg=30.0)
    assert 0 < statistics.spots_too_oblique < 24
    assert np.isnan(samples.values[:, samples.spots.transmitted == 0]).all()


def test_highlights_are_masked(captured) -> None:  # type: ignore[no-untyped-def]
    folder, mesh = captured
    none = samples_of(folder, mesh, footprint_reading, highlight_deg=0.0)[1]
    some = samples_of(folder, mesh, footprint_reading, highlight_deg=20.0)[1]
    assert none.entries_in_highlight == 0 < some.entries_in_highlight
    assert some.coverage < none.coverage


def test_a_damaged_image_costs_itself(captured, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    folder, mesh = captured
    copy = tmp_path / "capture"
    shutil.copytree(folder, copy)
    samples, _ = samples_of(folder, mesh, footprint_reading)
    used = np.flatnonzero(samples.spots.transmitted > 0)
    with StreamReader(folder) as stream:
        hit = next(a for a in stream.plan.addresses() if a.spot == used[len(used) // 2])
        at = stream._entry(hit).payload_offset + 5
    blob = bytearray((copy / "images.bin").read_bytes())
    blob[at] ^= 0xFF
    (copy / "images.bin").write_bytes(blob)
    _, statistics = samples_of(copy, mesh, footprint_reading)
    assert statistics.corrupt == (str(hit),)


def test_boundary_is_measured(captured) -> None:  # type: ignore[no-untyped-def]
    """Rationale: with the right R_d and a smooth sphere the ratio is 1; with R_d a tenth too small it is 1.1."""
    folder, mesh = captured
    samples, _ = samples_of(folder, mesh, footprint_reading)
    exact = np.stack([samples.spot_pairs.mean(lambda d, k=k: reflectance(d, k)) for k in range(2)])
    smooth = measure_boundary(mesh, ETA, samples.glow, lambda _: exact)
    assert smooth.cosines == tuple(sorted(smooth.cosines))
    steep = np.array(smooth.cosines) > 0.3
    np.testing.assert_allclose(np.array(smooth.ratio)[steep], 1.0, atol=0.05)
    other = measure_boundary(mesh, ETA, samples.glow, lambda _: exact / 1.1)
    np.testing.assert_allclose(np.array(other.ratio)[steep], 1.1 * np.array(smooth.ratio)[steep], rtol=1e-6)


def test_everything_is_written(result) -> None:  # type: ignore[no-untyped-def]
    work, made = result
    assert json.loads((work / "pipeline.json").read_text())["format_version"] == 1
    assert set(made["methods"]) == set(METHODS)
    assert {"what", "because"} == set(made["left_out"][0])
    assert all(row["seconds"] >= 0 and row["peak_mb"] > 10 for row in made["stages"])
    assert Calibration.load(work / "calibration.json").source == "nominal"
    for method in METHODS:
        image = np.load(work / "relit" / method / "uniform@held.npy")
        assert image.shape == (2, 80, 96)
        assert image.dtype == np.float32


def test_the_model_relights_the_sphere(result) -> None:  # type: ignore[no-untyped-def]
    """Rationale: under uniform light the radiosity of a sphere is pi Tbar L times the integral of R_d, everywhere."""
    work, _ = result
    model = RelightableModel.load(work / "model-default.npz")
    area = RayMesh.of(model.mesh).vertex_areas
    theta = np.linspace(0, np.pi, 4001)
    ring = 2 * np.pi * RADIUS**2 * np.sin(theta)
    for laser in range(2):
        exact = np.trapezoid(ring * reflectance(2 * RADIUS * np.sin(theta / 2), laser), theta)
        total = model.terms[0].reflectance[laser] @ area
        assert total.mean() == pytest.approx(exact, rel=0.03)
        assert total.std() < 0.03 * exact


def test_a_relit_image_is_replaced_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    view, lights = rig().cameras[0].model_dump(), [{"kind": "uniform", "name": "u", "colour": [1, 1, 1]}]
    request = Request.model_validate({"format_version": 1, "relight": {"views": [view], "lights": lights}})
    same = {name: lambda *_: np.zeros(2) for name in ("prepare", "lit_by", "seen_by", "image")}
    models = {"dipole": SimpleNamespace(mesh=None, boundary=None, image_variance=lambda *_: None, **same)}
    relight(models, request, tmp_path, Stages())  # type: ignore[arg-type]
    (image,) = tmp_path.rglob("*.npy")

    def half(file: IO[bytes], _: object) -> None:
        file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "save", half)
    with pytest.raises(KeyboardInterrupt):
        relight(models, request, tmp_path, Stages())  # type: ignore[arg-type]
    assert np.load(image).shape == (2,) and list(image.parent.iterdir()) == [image]


def test_samples_are_read_back(captured, result, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    """Expected behaviour: a method that is given the samples' file makes the same model, bit for bit."""
    folder, _ = captured
    work, _ = result
    samples, _ = samples_of(folder, read_scan(folder / "scan.ply"), footprint_reading)
    again = load_samples(work / "samples.npz")
    for name in ("values", "dark_variance", "noise_per_signal", "oblique", "tilt"):
        np.testing.assert_array_equal(getattr(again, name), getattr(samples, name))
    model = reconstruct(again, "default")
    model.save(tmp_path / "again.npz")
    with np.load(work / "model-default.npz") as kept, np.load(tmp_path / "again.npz") as made:
        assert kept.files == made.files
        for name in kept.files:
            np.testing.assert_array_equal(kept[name], made[name])
    with np.load(work / "samples.npz") as data:
        np.savez(tmp_path / "cut.npz", **{n: a for n, a in data.items() if n != "view0.image"})
    np.savez(tmp_path / "old.npz", format_version=1, values=samples.values)
    for name in ("cut.npz", "old.npz", "none.npz"):
        with pytest.raises(InputError, match=name) as caught:
            load_samples(tmp_path / name)
        assert "\n" not in str(caught.value)


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(arguments) == 2
    said = capsys.readouterr().err.strip()
    assert "\n" not in said
    return said


def test_bad_input_is_one_line(captured, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:  # type: ignore[no-untyped-def]
    folder, _ = captured
    request = tmp_path / "request.json"
    request.write_text('{"format_version": 1, "reconstruct": {"eta": 0.5}}')
    work = str(tmp_path / "work")
    assert "eta" in refusal(capsys, str(folder), work, "--request", str(request))
    request.write_text('{"format_version": 1}')
    assert "rig.json" in refusal(capsys, str(tmp_path / "nowhere"), work, "--request", str(request))
    short = tmp_path / "short"
    shutil.copytree(folder, short)
    (short / "images.bin").write_bytes((short / "images.bin").read_bytes()[:-300])
    assert "images" in refusal(capsys, str(short), work, "--request", str(request))
    flat = tmp_path / "flat"
    shutil.copytree(folder, flat)
    (flat / "scan.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    assert "scan.ply" in refusal(capsys, str(flat), work, "--request", str(request))


def test_runs_without_a_renderer(captured, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    """Expected behaviour: the process ends well where importing mitsuba or drjit fails."""
    folder, _ = captured
    request = tmp_path / "request.json"
    request.write_text('{"format_version": 1, "reconstruct": {"methods": ["lambertian"]}}')
    code = (
        "import sys; sys.modules['mitsuba'] = None; sys.modules['drjit'] = None; sys.modules['disco_twin'] = None\n"
        "from pipeline.run import main\n"
        f"sys.exit(main([{str(folder)!r}, {str(tmp_path / 'work')!r}, '--request', {str(request)!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "work" / "model-lambertian.npz").is_file()
