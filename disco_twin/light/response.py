"""The object's response to laser spots, as the twin's cameras will see it: simulated ahead, kept on disk, reused.

A spot's images depend on (seed, spot) alone, not on what it was simulated together with, so an interrupted capture
continues with the very same light. The halves of its walks are independent: how they differ is what the noise is. Where
a scene asks for it, plain and split walks make the images together, each counted where its photons are dense
(docs/decisions/0130).
"""

from __future__ import annotations

import hashlib
import logging
import zlib
from collections.abc import Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from disco_twin.faults.actual_rig import ActualRig
from disco_twin.light.importance import Splitting
from disco_twin.light.sources import BeamSource, Source
from disco_twin.light.spot_walks import EFFORT, SpotWalks
from disco_twin.light.transport import Transport
from disco_twin.object.build import TwinObject
from hw.base.arrays import F32, F64
from hw.base.errors import refused_by_the_disk
from hw.base.files import replacing
from hw.interface import Aim
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.nominal_rig import RigConfig

log = logging.getLogger(__name__)


CHUNK = 20  # spots simulated together and kept in one file
FLOODLIGHT = 2e-5  # W/(mm^2 sr) that a white surface shows face on


def light_key(obj: TwinObject, config: RigConfig, actual: ActualRig) -> str:
    """Key of what a spot's images depend on beside aim, walks and seed: object, cameras, turntable, beam."""
    medium, boundary = obj.medium, obj.boundary
    projector = actual.projector
    parts: list[ArrayLike] = [obj.mesh.vertices, obj.mesh.faces, medium.sigma_t, medium.albedo, medium.g]
    parts += [] if medium.g_voxels is None else [medium.g_voxels]
    parts += [part for body in obj.inside for part in (body.mesh.vertices, body.mesh.faces)]
    parts += [medium.low, medium.high, *actual.turns, projector.pose, projector.full_angle_rad]
    parts += [projector.steps, projector.separation_mm, actual.mirror_steps, actual.seed]
    for camera in actual.cameras:
        parts += [(camera.width, camera.height), camera.focal, camera.centre, camera.distortion, camera.pose]
    fixed = boundary, config.projector.beam_diameter_mm, config.projector.beam_profile
    digest = hashlib.sha256(repr((*fixed, *((b.around, b.wall, b.medium) for b in obj.inside))).encode())
    for part in map(np.ascontiguousarray, parts):
        digest.update(repr((part.dtype.str, part.shape)).encode())
        digest.update(part.tobytes())
    return digest.hexdigest()


class SpotResponses:
    """Implements `disco_twin.emulation.twin_rig.ResponseSource` by the photon walk.

    Each chunk of spots is one file `spots-<name>.npy` in `scratch`, (2, spots, C, L, H, W) float32 radiance per
    watt: the image, and that of the first half of its walks. `code` is the key of the code that simulates: what other
    code left is not read.
    """

    def __init__(
        self, transport: Transport, config: RigConfig, actual: ActualRig, walks: SpotWalks, seed: int, scratch: Path,
        code: str = "",
    ) -> None:  # fmt: skip
        self.transport, self.config, self.actual = transport, config, actual
        self.walks, self.seed, self.scratch = walks, seed, scratch
        self.views = [
            [actual.camera(c, j) for c in range(len(config.cameras))] for j in range(len(config.turntable_angles_deg))
        ]
        self._key = (light_key(transport.object, config, actual), walks, seed, code)
        self._chunk_of: dict[Aim, tuple[Aim, ...]] = {}
        self._loaded: tuple[tuple[Aim, ...], F32] | None = None
        scratch.mkdir(parents=True, exist_ok=True)

    def prepare(self, aims: Sequence[Aim]) -> None:
        """Note which spots come next; they are simulated in chunks when the first of a chunk is asked for."""
        for angle in sorted({aim.angle for aim in aims}):
            ahead = [aim for aim in dict.fromkeys(aims) if aim.angle == angle and aim not in self._chunk_of]
            for low in range(0, len(ahead), CHUNK):
                chunk = tuple(ahead[low : low + CHUNK])
                self._chunk_of.update(dict.fromkeys(chunk, chunk))

    def image(self, camera: int, aim: Aim, laser: int) -> F32:
        """(H, W) radiance per watt in W/(mm^2 sr)."""
        return self._spot(aim)[0, camera, laser]

    def _spot(self, aim: Aim) -> F32:
        if aim not in self._chunk_of:
            self.prepare([aim])
        chunk = self._chunk_of[aim]
        if self._loaded is None or self._loaded[0] != chunk:
            self._loaded = (chunk, self._load(chunk))
        return np.asarray(self._loaded[1][:, chunk.index(aim)])

    def _load(self, chunk: tuple[Aim, ...]) -> F32:
        name = hashlib.sha256(repr((self._key, chunk)).encode()).hexdigest()[:16]
        path = self.scratch / f"spots-{name}.npy"
        if not path.exists():
            simulated = self._simulate(chunk)
            try:
                with replacing(path) as file:
                    np.save(file, simulated)
            except OSError as error:
                raise refused_by_the_disk(error, path) or error from error
        return np.asarray(np.load(path, mmap_mode="r"))

    def _simulate(self, chunk: tuple[Aim, ...]) -> F32:
        origins, directions = self.actual.spot_rays(chunk)
        beam, cameras = self.config.projector, self.views[chunk[0].angle]

        def source(group: Sequence[int]) -> Source:
            power = np.ones((len(chunk), len(group)))
            return BeamSource(origins, directions, beam.beam_diameter_mm / 2, power, beam.beam_profile)

        def images(walks: int, kind: str = "", split: Splitting | None = None) -> F32:
            names = np.array([zlib.crc32(f"{aim!r}{kind}".encode()) for aim in chunk], np.uint32)
            traced = self.transport.trace(
                source, len(chunk), walks, seed=self.seed, streams=names, cameras=cameras, split=split, halve=True
            )
            assert traced.images is not None and traced.first_half is not None
            return np.stack([traced.images[:, 0], traced.first_half[:, 0]])

        if not self.walks.split:
            return images(self.walks.plain)
        entries, ratio = places_of_entry(self.transport, origins, directions), self.walks.plain / self.walks.split
        return images(self.walks.plain, "", Splitting(entries, EFFORT, "plain", ratio)) + images(
            self.walks.split, "split", Splitting(entries, EFFORT, "split", ratio)
        )

    def silhouette(self, camera: int, angle: int) -> F32:
        """(H, W) radiance of the object, dusted white, under floodlights around the camera; the background is dark."""
        return floodlit(self.transport.scene, self.views[angle][camera])


def places_of_entry(transport: Transport, origins: F64, directions: F64) -> F64:
    """(N, 3) where the axes of beams (N, 3) meet the object, mm; of those that miss it, the vertex that is nearest."""
    ray = mi.Ray3f(mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f(directions.T.astype(np.float32)))
    hit = transport.scene.ray_intersect(ray, mi.RayFlags.Minimal, True, True)
    places = np.array(hit.p).T.astype(float)
    for k in np.flatnonzero(~np.array(hit.is_valid())):
        offset = transport.vertices - origins[k]
        beside = offset - (offset @ directions[k])[:, None] * directions[k]
        places[k] = transport.vertices[np.argmin((beside**2).sum(axis=1))]
    return places


def floodlit(scene: mi.Scene, camera: PinholeCamera, supersample: int = 4) -> F32:
    """(H, W) radiance of a Lambertian object lit from the camera's direction and, more weakly, from all around."""
    origins, directions = camera.rays(camera.pixel_centres(supersample))
    ray = mi.Ray3f(mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f(directions.T.astype(np.float32)))
    hit = scene.ray_intersect(ray, mi.RayFlags.Minimal, True, True)
    cosine = np.abs((np.array(hit.n).T * directions).sum(axis=1))
    shade = np.where(np.array(hit.is_valid()), 0.3 + 0.7 * cosine, 0.0) * FLOODLIGHT
    fine = shade.reshape(camera.height, supersample, camera.width, supersample)
    return fine.mean(axis=(1, 3)).astype(np.float32)
