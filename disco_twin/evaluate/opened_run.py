"""A run folder for a method developer: what was captured, reconstructed and scored, as arrays with names and units."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from disco_twin.evaluate import scores
from disco_twin.evaluate.columns import score_columns
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.object_pixels import ObjectPixels
from disco_twin.experiment.pipeline_process import load_results
from disco_twin.experiment.references import read_reference, reference_path
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.light.references import HALVES, LAYERS
from disco_twin.light.truth import Truth
from disco_twin.scene.scene import Scene
from hw.base.arrays import Bool
from hw.base.errors import InputError
from hw.record import RawImage
from pipeline.calibrate.calibration import Calibration
from pipeline.geometry.camera import PinholeCamera
from pipeline.model.relightable import RelightableModel
from pipeline.plan.plan import ImageAddress
from pipeline.reconstruct.samples.samples import Samples
from pipeline.reconstruct.samples.samples_file import load_samples
from pipeline.stream.stream import StreamReader

T = TypeVar("T")
AXES = {"model": "method", "light": "light", "view": "view"}  # of the scores, and what their rows call them
RADIANCE = "W mm-2 sr-1"


class ByMethod(Mapping[str, T]):
    """One thing for each reconstructed method, read when it is first asked for."""

    def __init__(self, names: Callable[[], Sequence[str]], load: Callable[[str], T]) -> None:
        self._names, self._load, self._loaded = names, load, dict[str, T]()

    def __getitem__(self, method: str) -> T:
        if method not in self._names():
            raise KeyError(f"{method!r} was not reconstructed here, only {', '.join(self._names())}")
        if method not in self._loaded:
            self._loaded[method] = self._load(method)
        return self._loaded[method]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names())

    def __len__(self) -> int:
        return len(self._names())


class SpotImages:
    """Random access to the capture's images. `view` counts camera by camera, turntable angle by angle."""

    def __init__(self, folder: RunFolder) -> None:
        self._folder, self.reader = folder, StreamReader(folder.capture)

    @cached_property
    def calibration(self) -> Calibration:
        """What the pipeline measured of cameras, poses and projector, or the nominal rig."""
        return Calibration.load(self._folder.work / "calibration.json")

    def raw(self, view: int, spot: int, laser: int) -> xr.Dataset:
        """Exposure exponent and charge of each pixel. Raises: CorruptImage where the file is damaged there."""
        image = self._read(view, spot, laser)
        exponent, charge = (_array(a, "row column", unit) for a, unit in ((image.exponent, "1"), (image.charge, "DN")))
        return xr.Dataset({"exponent": exponent, "charge": charge})

    def radiance(self, view: int, spot: int, laser: int) -> xr.Dataset:
        """Calibrated radiance, its variance, and whether a pixel is saturated. Raises: as `raw`."""
        image = self.calibration.radiance(self._read(view, spot, laser), view, laser)
        parts = {"radiance": RADIANCE, "variance": f"({RADIANCE})2", "saturated": "1"}
        return xr.Dataset({name: _array(getattr(image, name), "row column", unit) for name, unit in parts.items()})

    def _read(self, view: int, spot: int, laser: int) -> RawImage:
        return self.reader.read(ImageAddress(view, "spot", spot, laser))


class OpenedRun:
    """A run folder. Opening reads its journal alone; everything else is read when it is first asked for.

    Raises: InputError for a folder that is no run, and, from what is asked for, where its stage is not finished.
    """

    def __init__(self, root: Path) -> None:
        self.folder = RunFolder.open(root)
        self.models: Mapping[str, RelightableModel] = ByMethod(
            self._methods, lambda method: scores.load_model(self.folder, method)
        )
        self.relit: Mapping[str, xr.DataArray] = ByMethod(
            self._methods, lambda method: self._pictures(lambda *where: scores.load_relit(self.folder, method, *where))
        )

    def _finished(self, *stages: str) -> None:
        for name in stages:
            if name not in self.folder.stages or not self.folder.stages[name].finished:
                remedy = f"disco-twin run SCENE --out {self.folder.root}"
                raise InputError(f"the stage {name} is not finished", file=self.folder.root, remedy=remedy)

    def _methods(self) -> Sequence[str]:
        self._finished("pipeline")
        return tuple(load_results(self.folder).methods)

    @cached_property
    def experiment(self) -> Experiment:
        """The scene, and the object and the scan built from it."""
        return Experiment(self.folder.read_scene())

    @property
    def scene(self) -> Scene:
        """The scene as it was run: its profile applied."""
        return self.experiment.scene

    @cached_property
    def stream(self) -> SpotImages:
        """The capture's images."""
        return SpotImages(self.folder)

    @cached_property
    def method_input(self) -> Samples:
        """What a method is given (read by footprint): `reconstruct(run.method_input, "mine")`."""
        self._finished("pipeline")
        return load_samples(self.folder.work / "samples.npz")

    @cached_property
    def samples(self) -> xr.Dataset:
        """Measured R_d from spots to vertices, NaN where no camera saw the vertex, and where both lie. What the surface
        reflects has been taken off where it was found.
        """
        given = self.method_input
        entry, place = "laser spot vertex", "spot axis"
        arrays = {
            "reflectance": _array(given.values, entry, "mm-2"),
            "variance": _array(given.variance, entry, "mm-4"),
            "dark_variance": _array(given.dark_variance, entry, "mm-4"),
            "noise_per_signal": _array(given.noise_per_signal, entry, "mm-2"),
            "oblique_variance": _array(given.oblique, "spot vertex", "1"),
            "tilt": _array(given.tilt, "spot vertex", "1"),
            "view_cosine": _array(given.cosine, "spot vertex", "1"),
            "spot_position": _array(given.spots.position, place, "mm"),
            "spot_direction": _array(given.spots.direction, place, "1"),
            "spot_transmittance": _array(given.spots.transmitted, "spot", "1"),
            "vertex_position": _array(given.mesh.vertices, "vertex axis", "mm"),
            "face": _array(given.mesh.faces, "triangle corner", "1"),
        }
        attrs = {"assumed_eta": given.eta, "beam_radius_mm": given.spots.beam_radius}
        return xr.Dataset(arrays, self._lasers | {"axis": list("xyz")}, attrs)

    @cached_property
    def truth(self) -> xr.Dataset:
        """Exitance per irradiance from some vertices (`vertex_in`) to all; a model's own are its `exitance_columns`."""
        self._finished("truth")
        truth, dims = Truth.load(self.folder.twin / "truth.npz"), "laser vertex_in vertex"
        arrays = {
            "exitance": _array(truth.mean, dims, "mm-2"),
            "standard_error": _array(truth.standard_error, dims, "mm-2"),
            "vertex_area": _array(truth.area, "vertex", "mm2"),
        }
        return xr.Dataset(arrays, self._lasers | {"vertex_in": truth.columns})

    @cached_property
    def references(self) -> xr.DataArray:
        """Mitsuba's images in two independent halves; a model of R_d answers for the layer `subsurface`."""
        self._finished("references")
        lights, views, folder = self.scene.relight.lights, self.scene.relight.views, self.folder.twin / "references"
        loaded = [[read_reference(reference_path(folder, light, view)).halves for view in views] for light in lights]
        names = {"half": list(HALVES), "layer": list(LAYERS)}
        stacked = np.moveaxis(_stacked(loaded), (2, 3), (0, 1))
        return _array(stacked, "half layer light view laser row column", RADIANCE, **names, **self._relit_names)

    @cached_property
    def masks(self) -> xr.DataArray:
        """(view, row, column) pixels that the object fills by at least a half."""
        return self._where(lambda pixels: pixels.mask)

    @cached_property
    def rims(self) -> xr.DataArray:
        """(view, row, column) those of `masks` that see the surface so obliquely that they are scored apart."""
        return self._where(lambda pixels: pixels.rim)

    def _where(self, chosen: Callable[[ObjectPixels], Bool]) -> xr.DataArray:
        views = self.scene.relight.views
        images = [[chosen(self.experiment.object_pixels(view)).astype(float) for view in views]]
        return _array(_stacked(images)[0] == 1, "view row column", "1", view=self._relit_names["view"])

    @cached_property
    def scores(self) -> xr.Dataset:
        """nrmse and the other scores by model, light and view; log10_rmse of R_d and coverage by model and decade;
        column totals over the truth's by model, columns (lit or unlit) and laser.
        """
        self._finished("scores")
        return _scores(scores.load_scores(self.folder), len(self.scene.rig.lasers))

    def relight(self, model: RelightableModel) -> xr.DataArray:
        """Images of a model under the scene's lights in its held-out views, named as those of `relit`."""
        lights = {light.name: model.lit_by(light) for light in self.scene.relight.lights}
        views = {v.name: model.seen_by(PinholeCamera.from_config(v)) for v in self.scene.relight.views}
        return self._pictures(lambda light, view: model.image(lights[light], views[view.name]))

    def score(self, model: RelightableModel, name: str = "model") -> xr.Dataset:
        """All scores of a model, as `scores` has them for the reconstructed ones."""
        self._finished("truth", "references")
        images = self.relight(model)

        def image(method: str, light: str, view: Any) -> NDArray[np.float32]:
            return np.asarray(images.sel(light=light, view=view.name)[:, : view.height, : view.width])

        rows = scores.score_images(self.experiment, self.folder, (name,), image)
        columns = score_columns(self.experiment, self.folder, {name: lambda: model})
        return _scores({"relit": rows} | columns, len(self.scene.rig.lasers))

    @property
    def _lasers(self) -> dict[str, Any]:
        return {"wavelength_nm": ("laser", [laser.wavelength_nm for laser in self.scene.rig.lasers])}

    @property
    def _relit_names(self) -> dict[str, Any]:
        relight = self.scene.relight
        return self._lasers | {"light": [x.name for x in relight.lights], "view": [x.name for x in relight.views]}

    def _pictures(self, image: Callable[[str, Any], NDArray[Any]]) -> xr.DataArray:
        lights, views = self.scene.relight.lights, self.scene.relight.views
        images = _stacked([[image(light.name, view) for view in views] for light in lights])
        return _array(images, "light view laser row column", RADIANCE, **self._relit_names)


def _array(values: Any, dims: str, units: str, **coords: Any) -> xr.DataArray:
    return xr.DataArray(np.asarray(values), coords, dims.split(), attrs={"units": units})


def _stacked(images: Sequence[Sequence[NDArray[Any]]]) -> NDArray[Any]:
    """(lights, views, ..., H, W) from one image each; where views differ in size, the smaller end in NaN."""
    height, width = (max(image.shape[axis] for row in images for image in row) for axis in (-2, -1))

    def padded(image: NDArray[Any]) -> NDArray[Any]:
        missing = [(0, 0)] * (image.ndim - 2) + [(0, height - image.shape[-2]), (0, width - image.shape[-1])]
        return np.pad(image, missing, constant_values=np.nan)

    return np.stack([np.stack([padded(image) for image in row]) for row in images])


def _scores(kept: Mapping[str, Any], lasers: int) -> xr.Dataset:
    """Rows of `score_images` as `relit`, and what `score_columns` makes; None becomes NaN.

    The axis is called `model`: xarray's `sel` has an option `method` of its own.
    """
    relit, reflectance, totals = (kept[key] for key in ("relit", "reflectance", "totals"))
    names = {axis: list(dict.fromkeys(row[key] for row in relit)) for axis, key in AXES.items()}
    by_place = {tuple(row[key] for key in AXES.values()): row for row in relit}

    def table(figure: str) -> NDArray[np.float64]:
        rows = [by_place[place].get(figure) for place in itertools.product(*names.values())]
        return np.array(rows, np.float64).reshape([len(axis) for axis in names.values()])

    outside = [f"volpath_{figure}" for figure in scores.OUTSIDE]
    figures = [*scores.KEPT, *(f"rim_{figure}" for figure in scores.RIM)]
    figures += [figure for figure in outside if any(figure in row for row in relit)]
    out: dict[str, Any] = {figure: (tuple(AXES), table(figure)) for figure in figures}
    decades = list(dict.fromkeys(d for own in reflectance.values() if own for d in own["coverage"]))
    parts = {"log10_rmse_measured": "measured", "log10_rmse_completed": "completed", "coverage": "coverage"}
    for label, part in parts.items():
        rows = [[((reflectance.get(m) or {}).get(part) or {}).get(d) for d in decades] for m in names["model"]]
        out[label] = ("model", "decade"), np.array(rows, np.float64).reshape(len(rows), len(decades))
    columns = ("lit", "unlit")
    for figure in ("mean", "spread"):
        out[f"totals_{figure}"] = (
            ("model", "columns", "laser"),
            np.array(
                [[totals[m][c][figure] if m in totals else lasers * [None] for c in columns] for m in names["model"]],
                np.float64,
            ),
        )
    return xr.Dataset(out, names | {"decade": [int(d) for d in decades], "columns": list(columns)})
