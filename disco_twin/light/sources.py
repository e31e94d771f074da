"""Where photons start: laser spots, the hat functions of ground-truth R_d, and the lights of a scene.

A source launches photon `k` of tag `t` (a spot, a vertex, a replicate) with `launch(rng, tag, active)`, which returns
position, direction and the power in watts per wavelength that one photon would carry if it were launched alone; the
caller divides by the number of photons.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from disco_twin.light import sampling
from disco_twin.light.sampling import Rng
from hw.base.arrays import F64, I64
from pipeline.relight.lights import Colour, Directional, Environment, Light, TexturedProjector, Uniform


def weight_type(lasers: int) -> Any:
    """The Dr.Jit array that holds one weight per wavelength."""
    return {1: mi.Color1f, 2: mi.Vector2f, 3: mi.Color3f}[lasers]


def to_float(values: Any) -> Any:
    """A flat Dr.Jit Float array from NumPy data of any shape."""
    return mi.Float(np.ascontiguousarray(values, np.float32).ravel())


def opaque3(kind: Any, values: Any) -> Any:
    """A 3-vector whose components are not literals of the kernel, so that the compiled kernel serves every scene."""
    return kind(*[dr.opaque(mi.Float, float(v)) for v in values])


class Source(Protocol):
    """Starts photons (see above). `scale` is the usual weight of one, which sets the counts' quantum."""

    scale: float

    def launch(self, rng: Rng, tag: Any, active: Any) -> tuple[Any, Any, Any]: ...


class BeamSource:
    """Collimated beams, one a tag: origins, directions (T, 3) of the axes, power (T, L) in W.

    profile: "uniform" inside the radius, or "gaussian" with the radius at 1/e^2.
    """

    def __init__(self, origins: F64, directions: F64, radius: float, power: F64, profile: str = "uniform") -> None:
        self.origins, self.directions, self.last = to_float(origins), to_float(directions), len(origins) - 1
        self.radius, self.gaussian = dr.opaque(mi.Float, radius), profile == "gaussian"
        self.power, self.weight = to_float(power), weight_type(np.atleast_2d(power).shape[1])
        self.scale = max(float(np.max(power)), 1e-30)

    def launch(self, rng: Rng, tag: Any, active: Any) -> tuple[Any, Any, Any]:
        tag = dr.minimum(tag, self.last)  # a light's single beam serves all of its replicates
        axis = dr.gather(mi.Vector3f, self.directions, tag, active)
        centre = dr.gather(mi.Point3f, self.origins, tag, active)
        disc = sampling.gaussian_disc(rng) if self.gaussian else sampling.uniform_disc(rng)
        frame = mi.Frame3f(axis)
        position = centre + (frame.s * disc.x + frame.t * disc.y) * self.radius
        return mi.Point3f(position), mi.Vector3f(axis), dr.gather(self.weight, self.power, tag, active)


class HatSource:
    """Lambertian (cosine) light over piecewise linear functions on the mesh, 1 W per tag and wavelength.

    hats: per tag the (V,) values of a non-negative function at the mesh's vertices (its hat function).
    """

    def __init__(self, vertices: F64, faces: I64, hats: F64, lasers: int) -> None:
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        corner_face, corner_slot, cdf, start = [], [], [], [0]
        for hat in hats:
            mass = (hat[faces] * area[:, None]).ravel()  # integral over a face = area / 3 * sum of the corners' values
            index = np.flatnonzero(mass)
            corner_face.append(index // 3)
            corner_slot.append(index % 3)
            cdf.append(np.cumsum(mass[index]) / mass[index].sum())
            start.append(start[-1] + len(index))
        self.longest = max(len(c) for c in cdf)
        self.corner_face = mi.UInt32(np.concatenate(corner_face).astype(np.uint32))
        self.corner_slot = mi.UInt32(np.concatenate(corner_slot).astype(np.uint32))
        self.cdf, self.start = to_float(np.concatenate(cdf)), mi.UInt32(np.array(start, np.uint32))
        self.vertices, self.faces = to_float(vertices), mi.UInt32(faces.astype(np.uint32).ravel())
        self.lift = dr.opaque(mi.Float, 1e-4 * float(np.abs(vertices).max()))
        self.weight, self.scale = weight_type(lasers), 1.0

    def launch(self, rng: Rng, tag: Any, active: Any) -> tuple[Any, Any, Any]:
        position, direction, _ = self.arrive(rng, tag, active)
        return position, direction, self.weight(1.0)

    def arrive(self, rng: Rng, tag: Any, active: Any) -> tuple[Any, Any, Any]:
        """Where a photon arrives, in which direction it flies, and the surface's normal there."""
        low = dr.gather(mi.UInt32, self.start, tag, active)
        high = dr.gather(mi.UInt32, self.start, tag + 1, active) - 1
        u = rng.next()
        for _ in range(max(1, math.ceil(math.log2(self.longest + 1)))):  # bisection: first entry with cdf > u
            middle = (low + high) >> 1
            above = dr.gather(mi.Float, self.cdf, middle, active) > u
            high = dr.select(above, middle, high)
            low = dr.select(above | (low >= high), low, middle + 1)
        face = dr.gather(mi.UInt32, self.corner_face, high, active)
        slot = dr.gather(mi.UInt32, self.corner_slot, high, active)
        corner = []
        for k in range(3):
            slot_k = slot + k
            slot_k = dr.select(slot_k >= 3, slot_k - 3, slot_k)
            vertex = dr.gather(mi.UInt32, self.faces, 3 * face + slot_k, active)
            corner.append(dr.gather(mi.Point3f, self.vertices, vertex, active))
        b = sampling.hat_barycentrics(rng)
        normal = dr.normalize(dr.cross(corner[1] - corner[0], corner[2] - corner[0]))
        towards = mi.Frame3f(normal).to_world(sampling.cosine_hemisphere(rng))
        position = corner[0] * b.x + corner[1] * b.y + corner[2] * b.z + normal * self.lift
        return mi.Point3f(position), mi.Vector3f(-towards), normal


class DirectionalSource:
    """`Directional`: parallel light over a disc of the scene's bounding radius, with or without a sharp shadow edge."""

    def __init__(self, light: Directional, radius: float) -> None:
        direction = np.asarray(light.direction, float)
        direction /= np.linalg.norm(direction)
        side = np.zeros(3)
        if light.edge_side is not None:
            side = np.asarray(light.edge_side, float)
            side = side - direction * (side @ direction)
            side /= np.linalg.norm(side)
        self.direction = opaque3(mi.Vector3f, direction)
        self.side, self.offset = opaque3(mi.Vector3f, side), float(light.edge_offset_mm)
        self.edged, self.radius = light.edge_side is not None, radius
        power = light.irradiance * math.pi * radius**2 * np.asarray(light.colour)
        self.power, self.weight, self.scale = to_float(power), weight_type(len(power)), max(float(power.max()), 1e-30)

    def launch(self, rng: Rng, tag: Any, active: Any) -> tuple[Any, Any, Any]:
        disc = sampling.uniform_disc(rng)
        frame = mi.Frame3f(self.direction)
        position = (frame.s * disc.x + frame.t * disc.y - frame.n * 2.0) * self.radius
        weight = dr.gather(self.weight, self.power, mi.UInt32(0), active)
        if self.edged:
            weight = dr.select(dr.dot(self.side, position) >= self.offset, weight, 0.0)
        return mi.Point3f(position), mi.Vector3f(self.direction), weight


class EnvironmentSource:
    """`Environment` and `Uniform`: directions from a mixture of the sphere and the lobes, positions from a disc."""

    def __init__(self, light: Environment, radius: float) -> None:
        self.radius, self.weight = radius, weight_type(len(light.constant))
        self.constant = to_float(light.constant)
        axes = [np.asarray(lobe.direction, float) / np.linalg.norm(lobe.direction) for lobe in light.lobes]
        peak = [np.asarray(lobe.radiance, float) for lobe in light.lobes]
        kappa = [float(lobe.sharpness) for lobe in light.lobes]
        share = [4 * math.pi * float(np.mean(light.constant))]
        share += [float(p.mean()) * 2 * math.pi / k * (1 - math.exp(-2 * k)) for p, k in zip(peak, kappa, strict=True)]
        total = max(sum(share), 1e-30)  # black light is allowed
        self.share = np.asarray(share) / total
        self.scale = total * math.pi * radius**2
        self.brightest = max(float(np.max(light.constant)) + sum(float(p.max()) for p in peak), 1e-30)
        self.lobes = [
            (opaque3(mi.Vector3f, a), to_float(p), dr.opaque(mi.Float, k))
            for a, p, k in zip(axes, peak, kappa, strict=True)
        ]

    def launch(self, rng: Rng, tag: Any, active: Any) -> tuple[Any, Any, Any]:
        pick, towards = rng.next(), sampling.uniform_sphere(rng)
        edge = float(self.share[0])
        for (axis, _, kappa), share in zip(self.lobes, self.share[1:], strict=True):
            candidate = sampling.von_mises_fisher(rng, axis, kappa)
            towards = dr.select((pick >= edge) & (pick < edge + share), candidate, towards)
            edge += float(share)
        radiance = self.radiance(towards, active)
        density = mi.Float(float(self.share[0]) / (4 * math.pi))
        for (axis, _, kappa), share in zip(self.lobes, self.share[1:], strict=True):
            density = density + float(share) * sampling.von_mises_fisher_pdf(dr.dot(axis, towards), kappa)
        disc = sampling.uniform_disc(rng)
        frame = mi.Frame3f(towards)
        position = (frame.n * 2.0 + frame.s * disc.x + frame.t * disc.y) * self.radius
        return mi.Point3f(position), mi.Vector3f(-towards), radiance * (math.pi * self.radius**2) / density

    def radiance(self, towards: Any, active: Any = True) -> Any:
        """W/(mm^2 sr) per wavelength that comes from the direction `towards`."""
        zero = mi.UInt32(0)
        radiance = dr.gather(self.weight, self.constant, zero, active)
        for axis, peak, kappa in self.lobes:
            cosine = dr.dot(axis, towards)
            radiance = radiance + dr.gather(self.weight, peak, zero, active) * dr.exp(kappa * (cosine - 1.0))
        return radiance


class ProjectorSource:
    """`TexturedProjector`: uniform over the part of the slide that can reach the object's bounding sphere."""

    def __init__(self, light: TexturedProjector, radius: float) -> None:
        from pipeline.geometry.camera import look_at

        pose = look_at(light.position_mm, light.aim_mm, light.up)
        self.distance = float(np.linalg.norm(np.subtract(light.aim_mm, light.position_mm)))
        centre = pose[:3, 3]  # the object's centre (the origin) in the projector's frame
        reach = (radius + float(np.hypot(*centre[:2]))) * self.distance / max(centre[2] - radius, 1e-3)
        self.half = min(light.half_width_mm, reach)
        self.rotation = [opaque3(mi.Vector3f, row) for row in pose[:3, :3]]
        self.position = opaque3(mi.Point3f, light.position_mm)
        self.period, self.contrast = float(light.period_mm), float(light.contrast)
        self.power = to_float(light.intensity * np.asarray(light.colour))
        self.weight = weight_type(len(light.colour))
        self.scale = light.intensity * (2.0 * self.half / self.distance) ** 2

    def launch(self, rng: Rng, tag: Any, active: Any) -> tuple[Any, Any, Any]:
        a, b = (2.0 * rng.next() - 1.0) * self.half, (2.0 * rng.next() - 1.0) * self.half
        across, down, forward = self.rotation
        direction = dr.normalize(across * a + down * b + forward * self.distance)
        k = 2.0 * math.pi / self.period
        slide = (1.0 + self.contrast * dr.sin(k * a) * dr.sin(k * b)) / (1.0 + self.contrast)
        cosine = dr.dot(direction, forward)
        # d(omega) = cos^3 da db / D^2, and the intensity itself falls with cos^3.
        scale = cosine**6 * slide * (2.0 * self.half / self.distance) ** 2
        weight = dr.gather(self.weight, self.power, mi.UInt32(0), active) * scale
        return mi.Point3f(self.position), mi.Vector3f(direction), weight


def sky_source(light: Uniform | Environment, radius: float, lasers: Sequence[int]) -> EnvironmentSource:
    """The source of a light from all around for some lasers."""
    if isinstance(light, Uniform):
        light = Environment(constant=tuple(light.radiance * c for c in light.colour))

    def pick(colour: Colour) -> Colour:
        return tuple(colour[k] for k in lasers)

    lobes = tuple(lobe.model_copy(update={"radiance": pick(lobe.radiance)}) for lobe in light.lobes)
    return EnvironmentSource(Environment(constant=pick(light.constant), lobes=lobes), radius)


def light_source(light: Light, radius: float, lasers: Sequence[int]) -> Source:
    """The source of one of the scene's lights for some lasers; `radius` bounds the object around the origin (mm)."""
    if isinstance(light, Uniform | Environment):
        return sky_source(light, radius, lasers)
    colour = tuple(light.colour[k] for k in lasers)
    if isinstance(light, Directional):
        return DirectionalSource(light.model_copy(update={"colour": colour}), radius)
    if isinstance(light, TexturedProjector):
        return ProjectorSource(light.model_copy(update={"colour": colour}), radius)
    direction = np.asarray(light.direction, float)
    direction /= np.linalg.norm(direction)
    through = np.asarray(light.through_mm, float)
    origin = through - direction * (2 * radius + np.linalg.norm(through))
    power = light.power_w * np.asarray(colour, float)
    return BeamSource(origin[None], direction[None], light.diameter_mm / 2, power[None])
