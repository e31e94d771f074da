"""The samples' file: all that a method is given, so that one can be tried without reading the images again."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from hw.base.config import in_words
from hw.base.errors import InputError
from hw.base.files import load_arrays, save_arrays
from pipeline.geometry.camera import PinholeCamera
from pipeline.reconstruct.samples.samples import Samples, SpotSumImage
from pipeline.reconstruct.samples.spots import Spots
from pipeline.reconstruct.samples.surface_lobe import BeamReadings, SurfaceLobe

FORMAT_VERSION = 5
UNITS = {
    "values": "mm^-2", "dark_variance": "mm^-4", "noise_per_signal": "mm^-2", "oblique": "1", "tilt": "1",
    "cosine": "1", "position": "mm", "direction": "1", "normal": "1", "triangle": "1", "barycentric": "1",
    "transmitted": "1", "vertices": "mm", "faces": "1", "vertex_normals": "1",
    "spot": "1", "vertex": "1", "view": "1", "weight": "1",
}  # fmt: skip
_SAMPLES, _SPOTS, _READ = tuple(UNITS)[:6], tuple(UNITS)[6:12], tuple(UNITS)[15:]
_CAMERA = ("focal", "centre", "distortion", "pose")


def save_samples(path: Path, samples: Samples) -> None:
    """Write an .npz, replacing any older one as a whole."""
    mesh, arrays = samples.mesh, {name: getattr(samples, name) for name in _SAMPLES}
    arrays |= {name: getattr(samples.spots, name) for name in _SPOTS}
    arrays |= {"vertices": mesh.vertices, "faces": mesh.faces, "vertex_normals": mesh.vertex_normals}
    arrays |= {name: getattr(samples.read_in_beams, name) for name in _READ}
    cameras = []
    for n, view in enumerate(samples.glow):
        arrays |= {f"view{n}.image": view.image, f"view{n}.included": view.included}
        camera = {name: getattr(view.camera, name).tolist() for name in _CAMERA}
        cameras.append({"width": view.camera.width, "height": view.camera.height} | camera)
    head = {"units": UNITS, "eta": samples.eta, "beam_radius": samples.spots.beam_radius, "cameras": cameras}
    head["lobe"] = None if samples.lobe is None else asdict(samples.lobe)
    save_arrays(path, FORMAT_VERSION, {name: np.asarray(array) for name, array in arrays.items()}, **head)


def load_samples(path: Path) -> Samples:
    """What `save_samples` wrote. Raises: InputError for anything else."""
    remedy = "reconstruct again with this version"
    head, arrays = load_arrays(path, FORMAT_VERSION, remedy)
    try:
        if head["units"] != UNITS:
            raise InputError("unknown units", file=path, key="units", remedy=remedy)
        mesh = trimesh.Trimesh(
            arrays["vertices"], arrays["faces"], vertex_normals=arrays["vertex_normals"], process=False
        )
        views = []
        for n, given in enumerate(head["cameras"]):
            camera = PinholeCamera(given["width"], given["height"], *(np.array(given[name]) for name in _CAMERA))
            views.append(SpotSumImage(camera, arrays[f"view{n}.image"], arrays[f"view{n}.included"]))
        own: dict[str, Any] = {name: arrays[name] for name in _SAMPLES}
        places: dict[str, Any] = {name: arrays[name] for name in _SPOTS}
        spots = Spots(**places, beam_radius=float(head["beam_radius"]))
        given_lobe = head["lobe"]
        return Samples(
            mesh=mesh,
            eta=float(head["eta"]),
            spots=spots,
            glow=tuple(views),
            read_in_beams=BeamReadings(**{name: arrays[name] for name in _READ}),
            lobe=None if given_lobe is None else _lobe(**given_lobe),
            **own,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"is damaged ({in_words(error)})", file=path, remedy=remedy) from error


def _lobe(alphas: list[float], strengths: list[float], error: float, because: str) -> SurfaceLobe:
    """From JSON, which has lists."""
    return SurfaceLobe(tuple(alphas), tuple(strengths), error, because)
