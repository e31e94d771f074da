"""docs/howto/write-a-method.md as it stands, on a run from a known R_d; and what `open_run` makes of the folder."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from blocked_renderer import BLOCK
from frozen_run import NOISE, VIEWS, write_frozen_run

import disco_twin
from disco_twin.evaluate.opened_run import OpenedRun
from disco_twin.evaluate.scores import score_images
from disco_twin.experiment.references import outside_folder, reference_key, reference_path
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.light.references import Reference, load_reference, save_reference
from hw.base.errors import InputError
from pipeline.geometry.fresnel import Boundary
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel


@pytest.fixture(scope="module")
def followed(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A copy of the sources in which the page was followed, its run folder, without a renderer; the true R_d."""
    folder = tmp_path_factory.mktemp("copy")
    for name in ("hw", "pipeline", "disco_twin"):
        shutil.copytree(repository / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "out").mkdir()
    exact = write_frozen_run(folder / "out" / "quick")
    (folder / "sitecustomize.py").write_text(BLOCK)
    page = (repository / "docs" / "howto" / "write-a-method.md").read_text()
    blocks = re.findall(r"```(\w+)(?: file=(\S+))?\n(.*?)```", page, re.DOTALL)
    assert [kind for kind, _, _ in blocks] == ["python", "python", "python", "sh", "python"]
    script = []
    for kind, name, text in blocks:
        if name:
            (folder / name).write_text(text)
        elif kind == "sh":
            for words in map(str.split, text.splitlines()):
                script.append(
                    f"subprocess.run([sys.executable, '-m', 'disco_twin.cli.app', *{words[1:]!r}], check=True)"
                )
        else:
            script.append(text)
    code = "import subprocess, sys\n" + "\n".join(script)
    environment = os.environ | {"PYTHONPATH": str(folder)}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True, timeout=200
    )
    assert done.returncode == 0, done.stderr
    assert "flat" in done.stdout
    return folder / "out" / "quick", exact


@pytest.fixture(scope="module")
def run(followed: tuple[Path, np.ndarray]) -> OpenedRun:
    return disco_twin.open_run(followed[0])


def test_the_page_s_method_is_scored_beside_the_baselines(run: OpenedRun) -> None:
    assert list(run.models) == ["flat", "dipole", "lambertian"]
    assert run.scores.sizes == {"model": 3, "light": 2, "view": 2, "decade": 4, "columns": 2, "laser": 2}
    assert (run.folder.root / "report.html").is_file()
    nrmse = run.scores.nrmse
    assert (nrmse.sel(model="flat", light="directional") < nrmse.sel(model="lambertian", light="directional")).all()
    assert np.isnan(run.scores.log10_rmse_completed.sel(model="lambertian")).all()  # it states no R_d
    assert (abs(run.scores.totals_mean.sel(model="lambertian") - 1) < 0.1).all()
    with pytest.raises(KeyError, match="'default' was not reconstructed here, only flat, dipole, lambertian"):
        run.models["default"]


def test_arrays_have_names_and_units(run: OpenedRun) -> None:
    samples = run.samples
    assert samples.reflectance.dims == ("laser", "spot", "vertex")
    assert (samples.reflectance.units, samples.spot_position.units) == ("mm-2", "mm")
    scan = run.experiment.scan
    shape = {"laser": 2, "spot": 24, "vertex": len(scan.vertices), "axis": 3, "triangle": len(scan.faces), "corner": 3}
    assert samples.sizes == shape
    np.testing.assert_array_equal(samples.wavelength_nm, [635, 532])
    assert run.references.dims == ("half", "layer", "light", "view", "laser", "row", "column")
    assert run.relit["flat"].units == run.references.units == "W mm-2 sr-1"
    for view in VIEWS:  # the narrower one ends in NaN
        image, mask = run.relit["flat"].sel(light="uniform", view=view["name"]), run.masks.sel(view=view["name"])
        assert np.isfinite(image).sum() == 2 * view["height"] * view["width"]
        assert 0.05 < mask.mean() < 0.9
        assert np.isfinite(image.where(mask, 0.0)).all()


def test_a_perfect_model_scores_nothing_but_noise(followed: tuple[Path, np.ndarray], run: OpenedRun) -> None:
    """Rationale: the references are this model's images with 2 % of noise a half, the truth its columns with 1 %; a
    score removes either.
    """
    exact = followed[1]
    term = GlobalTerm(exact.astype(np.float32), np.ones(exact.shape[1:], bool))
    model = RelightableModel(run.experiment.scan, Boundary(1.3), (term,))
    entries = model.exitance_columns(run.truth.vertex_in.values).mean
    np.testing.assert_allclose(run.truth.exitance, entries, rtol=0.06)
    scores = run.score(model, "exact").sel(model="exact")
    assert (abs(scores.nrmse) < NOISE / 4).all()  # a pixel's noise over hundreds of pixels
    assert ((scores.nrmse_floor > NOISE / 2) & (scores.nrmse_floor < NOISE)).all()  # that of the halves' mean
    assert (abs(scores.energy_ratio - 1) < 4 * NOISE / np.sqrt(2 * 200)).all()
    assert float(scores.coverage.sel(decade=0)) == 1
    # 1 % is .0046 in log10; what is left of it after removal, over some hundred entries a decade, is a quarter at most
    assert (abs(scores.log10_rmse_completed.dropna("decade")) < 0.0046 / 2).all()
    assert (abs(scores.totals_mean - 1) < 4 * 0.01 / np.sqrt(80)).all()
    assert (abs(scores.totals_spread) < 0.01).all()


def test_an_error_at_the_rim_is_the_rim_s_alone(run: OpenedRun) -> None:
    """Rationale: images that are right but for the rim's pixels, which are twice as bright; and the other way round."""

    def scored(at_rim: float, elsewhere: float) -> list[dict[str, float]]:
        def image(_: str, light: str, view: CameraConfig) -> np.ndarray:
            shape = slice(None), slice(view.height), slice(view.width)
            pair = run.references.sel(layer="subsurface", light=light, view=view.name).mean("half").values[shape]
            rim = run.rims.sel(view=view.name).values[shape[1:]]
            return np.where(rim, at_rim, elsewhere) * pair

        return score_images(run.experiment, run.folder, ("known",), image)

    assert (run.rims <= run.masks).all()
    assert 0 < float(run.rims.sum()) < 0.3 * float(run.masks.sum())
    for row in scored(2.0, 1.0):
        assert abs(row["nrmse"]) < NOISE
        assert row["energy_ratio"] == pytest.approx(1, abs=NOISE)
        assert row["rim_nrmse"] == pytest.approx(1, rel=0.05)
    for row in scored(1.0, 1.5):
        assert row["nrmse"] == pytest.approx(0.5, rel=0.02)
        assert abs(row["rim_nrmse"]) < NOISE


def test_an_outside_reference_is_scored_beside_the_ordinary_one(run: OpenedRun) -> None:
    """Rationale: one light and view has an outside reference, ten per cent brighter than the ordinary one, whose noise
    it shares; then it is gone, and nothing tells of it.
    """
    light, view, folder = run.scene.relight.lights[0], run.scene.relight.views[1], run.folder.twin / "references"
    halves, key = load_reference(reference_path(folder, light, view)).halves, reference_key(run.scene, light, view)
    path = reference_path(outside_folder(folder), light, view)
    model = run.models["flat"]
    assert "volpath_nrmse" not in run.score(model)
    save_reference(path, Reference(np.float32(1.1) * halves, 0.03, key))
    scores = run.score(model).isel(model=0)
    assert int(scores.volpath_nrmse.count()) == int(scores.volpath_nrmse_se.count()) == 1
    place = {"light": light.name, "view": view.name}
    ordinary, outside = (float(scores[name].sel(place)) for name in ("nrmse", "volpath_nrmse"))
    image = run.relight(model).sel(place).values[:, : view.height, : view.width]
    a, b = halves[:, 0].astype(float)
    inner = run.experiment.object_pixels(view).inner
    a, b, image = a[:, inner], b[:, inner], image[:, inner]
    wanted = (((image - 1.1 * a) * (image - 1.1 * b)).sum() / (1.21 * a * b).sum()) ** 0.5
    assert outside == pytest.approx(wanted, rel=1e-3)  # half floats
    assert abs(outside - ordinary) > 0.01
    path.unlink()
    assert "volpath_nrmse" not in run.score(model)


def test_images_are_read_at_random(run: OpenedRun) -> None:
    """Expected behaviour: the radiance of a spot's image is what the samples were made of, and raw is its record."""
    image = run.stream.radiance(view=0, spot=5, laser=1)
    raw = run.stream.raw(view=0, spot=5, laser=1)
    assert image.radiance.shape == raw.charge.shape == (80, 96)
    brightest = image.radiance.argmax(["row", "column"])
    assert raw.exponent[brightest] == raw.exponent.max()
    assert not image.saturated.any()


def test_what_is_no_run_or_not_finished_is_one_line(followed: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is no run folder"):
        disco_twin.open_run(tmp_path)
    root = followed[0]
    begun = tmp_path / "begun"
    begun.mkdir()
    shutil.copy(root / "scene.json", begun)
    (begun / "stages.json").write_text('{"format_version": 2, "identity": "x", "stages": []}')
    assert RunFolder.open(begun).stages == {}
    for ask in ("samples", "truth", "references", "scores"):
        with pytest.raises(InputError, match="is not finished") as caught:
            getattr(disco_twin.open_run(begun), ask)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="the stage pipeline is not finished"):
        list(disco_twin.open_run(begun).models)
    with pytest.raises(InputError):
        _ = disco_twin.open_run(begun).stream
