"""The stage `scan`: what the pipeline is given beside images and their plan."""

from __future__ import annotations

from pathlib import Path

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.experiment.experiment import Experiment
from hw.base.errors import InputError
from hw.record import Sensor
from pipeline.calibrate.projector_fit import LEAST_SPOTS
from pipeline.plan.visibility import require_in_sight
from pipeline.records import write_capture_records

LEAST_SCATTERED = 1e-3  # scatterings on a way through the object, below which its light is lost in any noise


def write_scan(experiment: Experiment, capture: Path, sensor: Sensor | None = None) -> None:
    """The nominal rig, its sensor (the twin's, unless it is given), the scanned mesh.

    Raises: InputError, see `require_capturable`.
    """
    require_capturable(experiment)
    rig, scan = experiment.scene.rig, bytes(experiment.scan.export(file_type="ply"))
    write_capture_records(capture, scan, rig.nominal(), lars3_sensor(rig) if sensor is None else sensor)


def require_capturable(experiment: Experiment) -> None:
    """Refuse a scene whose devices do not reach the object, or whose capture the pipeline could not use.

    Raises: InputError.
    """
    rig = experiment.scene.rig
    sizes = {(c.width, c.height) for c in rig.cameras}
    if len(sizes) > 1:
        problem, remedy = "the twin's cameras must have one image size", "give all of them one width and height"
        raise InputError(problem, key="rig.cameras", value=sorted(sizes), remedy=remedy)
    for i, view in enumerate(experiment.scene.relight.views):
        require_in_sight(view, experiment.scan, f"relight.views[{i}]", f"the held-out view {view.name!r}")
    require_scattering(experiment)
    experiment.plan  # noqa: B018 - the plan refuses cameras, projector and spots that cannot be
    experiment.beyond_neck  # noqa: B018 - refuses a neck beside the object
    if rig.faults.deviation and rig.spots < LEAST_SPOTS:
        raise InputError(
            "too few to find the projector from, and the rig is off the nominal one", key="rig.spots", value=rig.spots,
            allowed=f"at least {LEAST_SPOTS} that a camera sees", remedy="more spots, or --no-faults",
        )  # fmt: skip


def require_scattering(experiment: Experiment) -> None:
    """Refuse an object in which next to no light is scattered: nothing of it would come out again.

    Raises: InputError.
    """
    medium, size_mm = experiment.object.medium, float(experiment.scan.scale)
    most = [float((t * a).max()) for t, a in zip(medium.sigma_t, medium.albedo, strict=True)]
    dark = [k for k, scattering in enumerate(most) if scattering * size_mm < LEAST_SCATTERED]
    if dark:
        nm = ", ".join(f"{experiment.scene.rig.lasers[k].wavelength_nm:g}" for k in dark)
        raise InputError(
            f"nothing scatters light of {nm} nm in the object: sigma_t times albedo is "
            f"{max(most[k] for k in dark):.2g} /mm at most", key="object.medium",
            allowed=f"{LEAST_SCATTERED / size_mm:.2g} and more somewhere",
            remedy="more sigma_t (in 1/mm) or albedo, or leave the laser out",
        )  # fmt: skip
