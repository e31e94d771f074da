"""What the report shows, read from a run folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from disco_twin.evaluate.scores import load_model, load_relit, load_scores, reference_halves
from disco_twin.experiment.experiment import Experiment, mm_per_pixel
from disco_twin.experiment.pipeline_process import load_results
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.light.truth import Truth
from disco_twin.report.figures import Comparison, Impulse
from disco_twin.report.page import ReportData
from hw.record import Sensor
from pipeline.calibrate.calibration import Calibration, nominal_calibration
from pipeline.geometry.nominal_rig import RigConfig
from pipeline.plan.plan import ImageAddress
from pipeline.stream.stream import CorruptImage, StreamReader

SPOTS_SHOWN = 4


def collect(experiment: Experiment, folder: RunFolder, summary: dict[str, Any]) -> ReportData:
    """Read what the report shows. Raises: InputError where a file of the run is missing or damaged."""
    scene = experiment.scene
    methods = list(dict.fromkeys(row["method"] for row in summary["relit"]))
    truth = Truth.load(folder.twin / "truth.npz")
    points = np.asarray(experiment.scan.vertices, np.float64)
    distance = np.linalg.norm(points[truth.columns][:, None] - points[None], axis=2)
    sensor = Calibration.load(folder.work / "calibration.json").sensor
    shown, damaged = impulses(experiment.scene.rig, folder.capture, sensor)
    columns = {method: load_model(folder, method).exitance_columns(truth.columns) for method in methods}
    made, scores = load_results(folder), load_scores(folder)
    return ReportData(
        summary=summary,
        wavelengths_nm=[laser.wavelength_nm for laser in scene.rig.lasers],
        main=summary["method"],
        impulses=shown,
        comparisons=comparisons(experiment, folder, methods, summary["relit"]),
        distance=distance,
        truth=truth.mean,
        models={m: np.asarray(own.mean, np.float64) for m, own in columns.items() if own is not None},
        decades={m: own for m, own in scores["reflectance"].items() if own is not None},
        totals=scores["totals"],
        seconds={name: entry.seconds for name, entry in made.methods.items()},
        balance={
            term: list(getattr(truth.balance, term) / truth.balance.launched)
            for term in ("escaped", "absorbed", "reflected", "boundary", "inside")
        },
        imbalance=float(np.abs(truth.balance.residual).max()),
        notes=[*notes(experiment), *damaged, *made.warnings],
    )


def notes(experiment: Experiment) -> list[str]:
    """Conditions under which the figures hold."""
    if experiment.scene.rig.faults.deviation:
        rig = "The actual rig deviates from the nominal one; the pipeline is given the nominal one only."
    else:
        rig = (
            "The rig's deviation is off: poses and projector are exactly the nominal ones, as a perfect calibration "
            "would find them."
        )
    return [rig, *(f"{line[0].upper()}{line[1:]}." for line in experiment.warnings)]


def impulses(rig: RigConfig, capture: Path, sensor: Sensor) -> tuple[list[list[Impulse]], list[str]]:
    """Rows: cameras, columns: spots spread over the turntable angles; at the laser of the longest wavelength.

    A spot with a damaged image is left out; the second list names that image.
    """
    calibration = nominal_calibration(rig, sensor)
    laser = int(np.argmax([x.wavelength_nm for x in rig.lasers]))
    columns: list[list[Impulse]] = []
    damaged: list[str] = []
    with StreamReader(capture) as stream:
        stream.require_complete()
        plan = stream.plan
        for spot in np.unique(np.linspace(0, len(plan.spots) - 1, SPOTS_SHOWN).astype(int)):
            angle, column = plan.spots[spot].angle, []
            for camera, config in enumerate(rig.cameras):
                view = camera * len(plan.angles_rad) + angle
                address = ImageAddress(view, "spot", int(spot), laser)
                try:
                    raw, meta = stream.read(address), stream.meta(address)
                except CorruptImage as corrupt:
                    damaged.append(f"The spot {spot} is not shown: {corrupt}.")
                    break
                image = calibration.radiance(raw, view, laser)
                power = meta.photodiode_w or calibration.lasers[laser].power_w
                radiance = (image.radiance / power).astype(np.float32)
                column.append(Impulse(config.name, int(spot), radiance, mm_per_pixel(config)))
            else:
                columns.append(column)
    return [list(row) for row in zip(*columns, strict=True)], damaged


def comparisons(
    experiment: Experiment, folder: RunFolder, methods: Sequence[str], relit: Sequence[dict[str, Any]]
) -> list[Comparison]:
    """Relit images beside the reference (its subsurface layer, both halves together) for every light and view.

    Raises: InputError where an image is missing or damaged.
    """
    out = []
    masks = {view.name: experiment.object_pixels(view).mask for view in experiment.scene.relight.views}
    for light in experiment.scene.relight.lights:
        for view in experiment.scene.relight.views:
            rows = [r for r in relit if r["light"] == light.name and r["view"] == view.name]
            out.append(
                Comparison(
                    light.name,
                    view.name,
                    reference_halves(folder, light, view).mean(axis=0),
                    {m: load_relit(folder, m, light.name, view) for m in methods},
                    masks[view.name],
                    mm_per_pixel(view),
                    {r["method"]: r["nrmse"] for r in rows if r["nrmse"] is not None},
                )
            )
    return out
