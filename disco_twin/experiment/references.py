"""Reference images of a scene: their key, where they lie, and how those that are missing are rendered.

An outside reference is the image of the same light and view by stock Mitsuba, in the same format, in a folder beside
the ordinary ones. A few scenes ship some (benchmarks/volpath_references.py makes them); no run renders any.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.keys import content_key
from disco_twin.light.references import RENDER_AGAIN, Reference, load_reference, save_reference
from hw.base.errors import InputError
from hw.base.files import write_atomically
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.relight.lights import Light

if TYPE_CHECKING:
    from disco_twin.scene.scene import Scene
    from pipeline.capture.loop import Progress

log = logging.getLogger(__name__)


def reference_key(scene: Scene, light: Light, view: CameraConfig) -> str:
    """Key of a reference image: object, wavelengths, light and view. Less noise makes it better, not another one."""
    lasers = [laser.wavelength_nm for laser in scene.rig.lasers]
    return content_key(scene.object.model_dump(), lasers, light.model_dump(), view.model_dump())


def reference_path(folder: Path, light: Light, view: CameraConfig) -> Path:
    """Where the reference of a light and view lies in a folder of references."""
    return folder / f"{light.name}@{view.name}.exr"


def read_reference(path: Path) -> Reference:
    """A reference; the EXR library's own lines on the screen are dropped, our message says the same in one.

    Raises: InputError where it is missing or damaged, or was saved by another program, which keeps what it knows.
    """
    try:
        with _quiet():
            found = load_reference(path)
    except (KeyError, ValueError, TypeError) as error:
        problem = "was saved by another program: it lacks what ours writes"
        raise InputError(problem, file=path, remedy=RENDER_AGAIN) from error
    if found.halves.ndim != 5 or not np.isfinite(found.halves).all():
        raise InputError("was saved by another program: its channels differ", file=path, remedy=RENDER_AGAIN)
    return found


@contextmanager
def _quiet() -> Iterator[None]:
    """Nothing that a library of C writes to the screen is shown in this block."""
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        sys.stderr.flush()
        kept = os.dup(2)
        os.dup2(nowhere.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)


def shipped_references(scene_file: Path, name: str) -> Path:
    """References that are committed beside a shipped scene."""
    return scene_file.parent / "references" / name


def outside_folder(folder: Path) -> Path:
    """Where outside references lie in a folder of references: apart from those that scores stand on."""
    return folder / "volpath"


def holds_outside_reference(folder: Path, scene: Scene, light: Light, view: CameraConfig) -> bool:
    """Whether a folder of references holds an outside one of this scene, light and view."""
    return load_outside_reference(folder, scene, light, view) is not None


def load_outside_reference(folder: Path, scene: Scene, light: Light, view: CameraConfig) -> Reference | None:
    """The outside reference of a light and view in a folder of references; None where there is none, or one of another
    scene, or (with a warning) a damaged one.
    """
    path = reference_path(outside_folder(folder), light, view)
    if not path.is_file():
        return None
    try:
        found = read_reference(path)
    except InputError as error:
        log.warning("%s", error.amended(remedy="delete it, or take it again from where the scene came from"))
        return None
    return found if found.key == reference_key(scene, light, view) else None


def keep_outside_references(scene: Scene, shipped: Path, own: Path) -> None:
    """Copy the shipped outside references of a scene into its own folder of references."""
    if shipped.resolve() == own.resolve():
        return
    for light in scene.relight.lights:
        for view in scene.relight.views:
            if holds_outside_reference(shipped, scene, light, view):
                source, target = (reference_path(outside_folder(f), light, view) for f in (shipped, own))
                target.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(target, source.read_bytes())


def holds_reference(folder: Path, experiment: Experiment, light: Light, view: CameraConfig) -> bool:
    """Whether a folder holds this scene's reference of a light and view, with as little noise as it asks for."""
    path = reference_path(folder, light, view)
    if not path.is_file():
        return False
    try:
        found = read_reference(path)
    except InputError as error:
        log.warning("%s; another one is rendered", error.amended(remedy=None))
        return False
    scene, wanted = experiment.scene, experiment.scene.simulation.reference_noise
    if found.halves.shape[2:] != (len(scene.rig.lasers), view.height, view.width):
        shape = " x ".join(map(str, found.halves.shape[2:]))
        log.warning("%s: is of %s lasers, rows and columns; another one is rendered", path, shape)
        return False
    return found.key == reference_key(scene, light, view) and found.noise <= wanted


def render_references(experiment: Experiment, shipped: Path, own: Path, progress: Progress) -> int:
    """Make sure that every reference lies in `own`: taken from `shipped`, kept from before, or rendered now. Outside
    references are taken from `shipped` where there are some.

    Returns how many lights had to be rendered. Raises: InputError where `own` is no folder.
    """
    scene, rendered = experiment.scene, 0
    lights = scene.relight.lights
    if own.exists() and not own.is_dir():
        raise InputError("is not a folder", file=own, remedy="choose another --out")
    own.mkdir(parents=True, exist_ok=True)
    keep_outside_references(scene, shipped, own)
    for done, light in enumerate(lights):
        progress(done, len(lights))
        missing = [view for view in scene.relight.views if not holds_reference(own, experiment, light, view)]
        for view in [view for view in missing if holds_reference(shipped, experiment, light, view)]:
            write_atomically(reference_path(own, light, view), reference_path(shipped, light, view).read_bytes())
            missing.remove(view)
        for size in sorted({(v.width, v.height) for v in missing}):
            _render(experiment, light, [v for v in missing if (v.width, v.height) == size], own)
        rendered += bool(missing)
    progress(len(lights), len(lights))
    return rendered


def _render(experiment: Experiment, light: Light, views: Sequence[CameraConfig], own: Path) -> None:
    transport = experiment.transport  # starts the renderer
    from disco_twin.light.rendering import render_reference  # what is stored can be read without one

    cameras = [PinholeCamera.from_config(v) for v in views]
    noise, seed = experiment.scene.simulation.reference_noise, experiment.seed(f"reference {light.name}")
    for view, halves in zip(views, render_reference(transport, light, cameras, noise, seed), strict=True):
        key = reference_key(experiment.scene, light, view)
        save_reference(reference_path(own, light, view), Reference(halves, noise, key))
