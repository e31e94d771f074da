"""Rows of light: photons between ends that are exact, diffuse or averaged over the scan's hat functions; no pipeline.

Views of different size are traced apart, since one trace has cameras of one size.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import NDArray

from disco_twin.evaluate.exact_light import ExactLight, best_curve
from disco_twin.evaluate.scores import reference_halves
from disco_twin.run.budget.rows import CONSISTENT, EXACT_ENTRY, EXACT_EXIT, FLOOR, LUMPED, SMOOTH, TRUE_MODEL, Images
from disco_twin.run.progress import Report
from disco_twin.run.stages import Run
from hw.base.arrays import F64
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import Boundary
from pipeline.reconstruct.global_term.boundary_fit import SeenRadiosity
from pipeline.relight.on_mesh import ViewOfMesh


class LightRows:
    """What a run's lights come to in its held-out views. walks: photons of a light, both halves together."""

    def __init__(self, run: Run, walks: int) -> None:
        self.run, self.walks = run, walks
        self.lights, self.views = run.scene.relight.lights, run.scene.relight.views
        self.cameras = [PinholeCamera.from_config(view) for view in self.views]
        self.smooth = Boundary(run.scene.reconstruct.eta)

    @cached_property
    def exact(self) -> ExactLight:
        """The object's light."""
        return ExactLight(self.run.experiment, self.smooth.eta, self.walks)

    def count(self, report: Report, photons: int) -> None:
        """Report photons from now on, of so many."""
        done = 0

        def walked(more: int) -> None:
            nonlocal done
            done += more
            report(min(done, photons), photons)

        self.exact.walked = walked
        report(0, photons)

    def exact_entry(self) -> dict[str, Images]:
        """Light enters as it does, and leaves diffusely: on the fine mesh, and averaged over the scan's hats."""
        exact = self.exact
        power = {light.name: exact.power_of(light) for light in self.lights}
        fine = {name: exact.radiosity(p) for name, p in power.items()}
        curve = self.best_curve(fine)
        rows = {EXACT_ENTRY: self.images(exact.mesh, curve, fine)}
        for row, consistent in ((LUMPED, False), (CONSISTENT, True)):
            hats = {name: exact.radiosity_on_hats(p, consistent) for name, p in power.items()}
            rows[row] = self.images(exact.scan, curve, hats)
        return rows

    def diffuse_ends(self) -> tuple[dict[str, Images], Boundary]:
        """Light enters from all around: what leaves is seen as it does, and diffusely. Rows, and the floor's curve."""
        exact = self.exact
        fine: dict[str, F64] = {}
        seen: dict[tuple[str, str], NDArray[np.floating]] = {}
        for light in self.lights:
            density = exact.entering(light)
            for size in dict.fromkeys((c.width, c.height) for c in self.cameras):
                own = [k for k, c in enumerate(self.cameras) if (c.width, c.height) == size]
                images, power = exact.after_diffuse_entry(light.name, density, [self.cameras[k] for k in own])
                assert images is not None
                seen |= {(light.name, self.views[k].name): images[:, at] for at, k in enumerate(own)}
            fine[light.name] = exact.radiosity(power)
        curve = self.best_curve(fine)
        smooth, floor = (self.images(exact.mesh, boundary, fine) for boundary in (self.smooth, curve))
        return {EXACT_EXIT: seen, SMOOTH: smooth, FLOOR: floor}, curve

    def true_model(self, curve: Boundary) -> dict[str, Images]:
        """What a model relights whose R_d is the truth's: the mean over the hat functions of both ends.

        curve: the floor's
        """
        exact, hats = self.exact, {}
        for light in self.lights:
            _, power = exact.after_diffuse_entry(f"{light.name} on hats", exact.entering_on_hats(light))
            hats[light.name] = exact.radiosity_on_hats(power, consistent=False)
        return {TRUE_MODEL: self.images(exact.scan, curve, hats)}

    def best_curve(self, radiosity: Mapping[str, F64]) -> Boundary:
        """`best_curve` of all lights and views, for radiosities (2, L, V) on the fine mesh."""
        seen = []
        for light in self.lights:
            for view, camera in zip(self.views, self.cameras, strict=True):
                reference = np.asarray(reference_halves(self.run.folder, light, view), float).mean(axis=0)
                seen.append(SeenRadiosity(camera, reference, radiosity[light.name].mean(axis=0)))
        return best_curve(self.exact.mesh, self.smooth.eta, seen)

    def images(self, mesh: trimesh.Trimesh, boundary: Boundary, radiosity: Mapping[str, F64]) -> Images:
        """Of (2, L, V) radiosities on a mesh, by light; in all views."""
        out: dict[tuple[str, str], NDArray[np.floating]] = {}
        for view, camera in zip(self.views, self.cameras, strict=True):
            seen = ViewOfMesh(camera, mesh, boundary)
            out |= {(light, view.name): np.stack([seen.image(h) for h in b]) for light, b in radiosity.items()}
        return out
