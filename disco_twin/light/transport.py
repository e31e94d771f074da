"""Light transport through one object: sets up the photon walk and turns its integer counts into images and deposits."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray

from disco_twin.light import tables as kernel
from disco_twin.light.balance import EnergyBalance
from disco_twin.light.distance import DistanceField, build_distance_field
from disco_twin.light.importance import Diffusion, Splitting, Views, diffusion, view_targets, window_targets
from disco_twin.light.majorants import LocalMajorants, local_majorants
from disco_twin.light.sources import EnvironmentSource, Source, opaque3, to_float, weight_type
from disco_twin.light.splitting import Window
from disco_twin.light.tables import FAR
from disco_twin.light.walk import Tally, walk
from disco_twin.light.walls import bsdf_of, walls_of
from disco_twin.object.bodies import OwnMedium
from disco_twin.object.build import Medium, TwinObject
from hw.base.arrays import F32, F64, I64
from pipeline.geometry.camera import PinholeCamera

LANES = 1 << 15
PHOTONS_PER_CALL = 1 << 22
ACCUMULATOR_BYTES = 256 << 20


@dataclass(frozen=True)
class CameraLobe:
    """The lobe connection: its concentration, the depth from which it starts and its longest flight, both in mm."""

    kappa: float
    reach: float
    length: float

    @classmethod
    def of(cls, medium: Medium, alpha: float) -> CameraLobe:
        """Six and twenty mean free paths, the narrower the smoother: docs/decisions/0010."""
        free_path = 1.0 / max(float(medium.sigma_t.mean()), 1e-9)
        return cls(40.0 / max(alpha, 0.02), 6.0 * free_path, 20.0 * free_path)


@dataclass(frozen=True)
class Traced:
    """What a trace measured, per watt of the source's own power scale.

    images: (T, layers, C, L, H, W) float32 radiance [1/(mm^2 sr) per W launched]; first_half: the same of the first
        half of the walks, which is independent of the second
    deposits: (T, L, V) float64 power that left at each vertex's hat function; each is None if not asked for
    """

    images: F32 | None
    first_half: F32 | None
    deposits: F64 | None
    balance: EnergyBalance


class Transport:
    """The object as the walk sees it: Mitsuba scene, distance field, medium tables, one group of wavelengths a walk.

    Wavelengths with the same sigma_t and g share one walk; the others get walks of their own (`groups`). local=False:
    one majorant for the whole object, which costs time; benchmarks and tests compare with it.
    """

    def __init__(self, obj: TwinObject, cells: int = 128, lobe: CameraLobe | None = None, local: bool = True) -> None:
        self.object = obj
        self.lobe = lobe or CameraLobe.of(obj.medium, obj.boundary.alpha)
        self.vertices = np.asarray(obj.mesh.vertices, np.float64)
        self.faces = np.asarray(obj.mesh.faces, np.int64)
        self.radius = float(np.linalg.norm(self.vertices, axis=1).max()) * 1.001
        self.lasers = len(obj.medium.sigma_t)
        self.groups = obj.groups()
        bsdfs: dict[str, dict[str, Any]] = {
            "rough": {
                "type": "roughdielectric", "int_ior": obj.boundary.eta, "ext_ior": 1.0,
                "alpha": obj.boundary.alpha, "distribution": "ggx",
            },
            "smooth": {"type": "dielectric", "int_ior": obj.boundary.eta, "ext_ior": 1.0},
            "matched": {"type": "null"},
        }  # fmt: skip
        surfaces = [(self.vertices, self.faces, bsdfs[obj.boundary.kind])]
        surfaces += [(body.mesh.vertices, body.mesh.faces, bsdf_of(body.wall)) for body in obj.inside]
        self._shapes = [shape_of(f"surface-{k}", *surface) for k, surface in enumerate(surfaces)]
        # Not optimised: meshes would be merged, and a hit could no longer tell them apart.
        named = {f"surface-{k}": shape for k, shape in enumerate(self._shapes)}
        self.scene = mi.load_dict({"type": "scene", **named}, optimize=False)
        self._cells, self._local = cells, local
        self._diffusion: dict[int, Diffusion] = {}
        self._last_targets: tuple[tuple[int, bytes, float], F64] | None = None
        self._kept: dict[tuple[int, ...], kernel.Tables] = {}

    @cached_property
    def _field(self) -> DistanceField:
        return object_field(self.object, self._cells)

    @cached_property
    def _distance(self) -> mi.Float:
        """The distances alone, for wavelengths without local majorants."""
        return to_float(self._field.distance)

    @cached_property
    def _inside(self) -> I64:
        """(N, 3) indices [z, y, x] of cells of the distance field that lie in the object: every fourth per axis."""
        field = self._field
        index = np.stack(np.meshgrid(*[np.arange(2, field.cells, 4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        centres = field.low + (index[:, ::-1] + 0.5) * field.cell
        return index[np.asarray(self.object.mesh.contains(centres))]

    @cached_property
    def _shared(self) -> dict[str, Any]:
        """Tables that do not depend on the wavelength."""
        field = self._field
        return dict(
            scene=self.scene,
            bsdf=self._shapes[0].bsdf(),
            matched=self.object.boundary.kind == "matched",
            shine=False,
            even=False,
            eta=self.object.boundary.eta,
            normal=to_float(field.normal),
            cells=field.cells,
            low=opaque3(mi.Point3f, field.low),
            inverse_cell=dr.opaque(mi.Float, 1 / field.cell),
            bound=dr.opaque(mi.Float, 1.01 * float(np.abs(self.vertices).max()) + 1e-3),
            faces=mi.UInt32(self.faces.astype(np.uint32).ravel()),
            vertices=to_float(self.vertices),
            vertex_count=len(self.vertices),
            kappa=dr.opaque(mi.Float, self.lobe.kappa),
            reach=dr.opaque(mi.Float, self.lobe.reach),
            length=dr.opaque(mi.Float, self.lobe.length),
            # Some 40 units in the last place of the largest coordinate: far below a free path, above rounding.
            lift=dr.opaque(mi.Float, 4e-6 * (1.0 + float(np.abs(self.vertices).max()))),
        )

    def _local_majorants(self, sigma_t: F64) -> LocalMajorants | None:
        medium, field = self.object.medium, self._field
        low, high = np.asarray(medium.low, float), np.asarray(medium.high, float)
        return local_majorants(sigma_t, low, high, field.low, field.cell, field.cells, self._inside)

    def uses_local_majorants(self) -> bool:
        """Whether any wavelength's flights go by local majorants."""
        return any(self._tables(group).local for group in self.groups)

    def _tables(self, group: tuple[int, ...]) -> kernel.Tables:
        """The walk's tables for a group of wavelengths, made once."""
        if group not in self._kept:
            self._kept[group] = self._make_tables(group)
        return self._kept[group]

    def _make_tables(self, group: tuple[int, ...]) -> kernel.Tables:
        medium = self.object.medium
        sigma_t = medium.sigma_t[group[0]].astype(np.float64)
        albedo = medium.albedo[list(group)].astype(np.float64)
        majorant = max(float(sigma_t.max()), 1e-9)
        homogeneous = bool(np.ptp(sigma_t) == 0 and np.all(np.ptp(albedo.reshape(len(group), -1), axis=1) == 0))
        channels = {1: 2, 2: 4, 3: 4}[len(group)]
        packed = np.zeros((*sigma_t.shape, channels), np.float32)
        packed[..., 0] = sigma_t / majorant
        packed[..., 1 : 1 + len(group)] = np.moveaxis(albedo, 0, -1)
        size = np.asarray(medium.high) - np.asarray(medium.low)
        local = self._local_majorants(sigma_t) if self._local and not homogeneous else None
        bounds = np.stack([self._field.distance, local.rate], axis=-1) if local is not None else None
        nz, ny, nx = sigma_t.shape
        own = [body.medium for body in self.object.inside if isinstance(body.medium, OwnMedium)]
        g, g_voxels = float(medium.g[group[0]]), medium.g_voxels
        return kernel.Tables(
            **self._shared,
            walls=walls_of(self.object.inside, self._shapes, group) if self.object.inside else None,
            lasers=len(group),
            homogeneous=homogeneous and sigma_t.max() > 0,
            isotropic=g == 0.0 and g_voxels is None and not any(any(m.g) for m in own),
            g=dr.opaque(mi.Float, g),
            g_voxels=None if g_voxels is None else to_float(g_voxels[group[0]]),
            majorant=dr.opaque(mi.Float, majorant),
            local=local is not None,
            stretch=dr.opaque(mi.Float, local.stretch if local is not None else FAR),
            distance=self._distance if bounds is None else to_float(bounds),
            medium=to_float(packed),
            albedo=weight_type(len(group))(*[dr.opaque(mi.Float, float(a.flat[0])) for a in albedo]),
            dims=mi.ScalarPoint3i(nx, ny, nz),
            medium_low=opaque3(mi.Point3f, medium.low),
            medium_scale=opaque3(mi.Vector3f, np.array([nx, ny, nz]) / size),
        )

    def _window(self, group: Sequence[int], split: Splitting | Views, tags: int) -> Window:
        """The tags' weight windows; tags whose light enters at one place share a map."""
        absorbed = [float((self.object.medium.sigma_t[k] * (1 - self.object.medium.albedo[k])).mean()) for k in group]
        laser = group[int(np.argmin(absorbed))]  # the others' light is fainter everywhere
        if laser not in self._diffusion:
            self._diffusion[laser] = diffusion(self.object, laser)
        estimate = self._diffusion[laser]
        if isinstance(split, Views):
            targets, maps = view_targets(estimate, split), np.zeros(tags, np.int64)
        else:
            places, maps = np.unique(split.entries, axis=0, return_inverse=True)
            targets = self._targets(laser, places, split.effort)
        return Window(
            target=to_float(targets),
            maps=mi.UInt32(maps.ravel().astype(np.uint32)),
            cells=len(estimate.number),
            part=split.part if isinstance(split, Splitting) else None,
            plain=dr.opaque(mi.Float, split.plain if isinstance(split, Splitting) else 1.0),
            low=opaque3(mi.Point3f, estimate.low),
            inverse_cell=dr.opaque(mi.Float, 1 / estimate.cell),
        )

    def _targets(self, laser: int, places: F64, effort: float) -> F64:
        """`window_targets` of light that enters at `places`; the last ones are kept, for two walks that share them."""
        key = laser, places.tobytes(), effort
        if self._last_targets is None or self._last_targets[0] != key:
            estimate = self._diffusion[laser]
            self._last_targets = key, window_targets(estimate.fluence(places), estimate.filled, effort)
        return self._last_targets[1]

    def trace(
        self,
        make_source: Callable[[Sequence[int]], Source],
        tags: int,
        walks: int,
        *,
        seed: int,
        streams: NDArray[np.uint32] | None = None,
        cameras: Sequence[PinholeCamera] = (),
        sky: Callable[[Sequence[int]], EnvironmentSource] | None = None,
        layers: int = 1,
        deposit: bool = False,
        first: int = 0,
        lanes: int = LANES,
        split: Splitting | Views | None = None,
        halve: bool = False,
        even: bool = False,
        shine: bool = False,
    ) -> Traced:
        """Walk `walks` photons (numbers `first`...) of each of `tags` tags.

        make_source: (group of laser indices) -> Source. sky: (group) -> light for walks that start at pixels, in place
        of cameras; images are (T, layers, 1, L, 1, 1) then. streams: (T,) names of the tags' random streams, so that a
        spot gives the same image whatever it is traced together with; 0, 1, 2, ... by default. split: weight windows,
        which make faint light as precise as bright, or lead to what the cameras see (importance.py). halve: keep the
        images of the first half of the walks, too. even: connections are (connect.py). shine: the surface reflects
        light and lets none in.
        """
        if cameras and self.object.inside and self.object.boundary.kind == "matched":
            raise ValueError("nothing connects to a camera through walls inside an object without a boundary")
        streams = np.arange(tags, dtype=np.uint32) if streams is None else streams.astype(np.uint32)
        parts = [
            self._trace_group(
                make_source(group), group, tags, walks, seed, streams, cameras, sky(group) if sky else None, layers,
                deposit, first, lanes, split, halve, even, shine,
            )
            for group in self.groups
        ]  # fmt: skip
        order = np.argsort([laser for group in self.groups for laser in group])

        def join(name: str, axis: int) -> Any:
            values = [getattr(p, name) for p in parts]
            if values[0] is None:
                return None
            return values[0] if len(values) == 1 else np.take(np.concatenate(values, axis), order, axis)

        names = EnergyBalance.__dataclass_fields__
        balance = EnergyBalance(**{k: np.concatenate([getattr(p.balance, k) for p in parts])[order] for k in names})
        balance.warn_of_loss()
        return Traced(join("images", 3), join("first_half", 3), join("deposits", 1), balance)

    def _trace_group(
        self, source: Source, group: tuple[int, ...], tags: int, walks: int, seed: int, streams: NDArray[np.uint32],
        cameras: Sequence[PinholeCamera], sky: EnvironmentSource | None, layers: int, deposit: bool, first: int,
        lanes: int, split: Splitting | Views | None, halve: bool, even: bool, shine: bool,
    ) -> Traced:  # fmt: skip
        tables = kernel.Tables(**vars(self._tables(group)) | {"even": even, "shine": shine})
        table = camera_table(cameras) if cameras else None
        met = kernel.Sky(source=sky) if sky is not None else None
        layout = (table.count, len(group), table.height, table.width) if table else (1, len(group), 1, 1) if met else ()
        numbers = 2 * layers * (int(np.prod(layout)) // len(group)) if layout else 0
        per_tag = 8 * len(group) * (numbers + deposit * len(self.vertices))
        batch = max(1, min(tags, ACCUMULATOR_BYTES // max(per_tag, 1), (1 << 31) // max(walks, 1)))
        names = mi.UInt32(streams)
        window = self._window(group, split, tags) if split is not None else None
        total = {name: np.zeros(len(group)) for name in Tally.__dataclass_fields__}
        images, first_half, deposits = [], [], []
        for low in range(0, tags, batch):
            n = min(batch, tags - low)
            shape = (n, layers, *layout)
            unit = sky.brightest if sky is not None else nearest_factor(cameras)
            pictures = new_images(layers, int(np.prod(shape)), source.scale * unit) if layout else None
            powers = new_deposits(n * len(group) * len(self.vertices), walks) if deposit else None
            step = max(1, min(walks, PHOTONS_PER_CALL // n))
            for start, m in stretches(walks, step):
                if start == walks // 2 and pictures is not None and halve:
                    first_half.append(read_images(pictures, shape, max(start, 1)))
                balance = walk(
                    tables, source, table, met, pictures, powers, dr.opaque(mi.UInt32, n * m), dr.opaque(mi.UInt32, m),
                    dr.opaque(mi.UInt32, first + start), dr.opaque(mi.UInt32, low), names,
                    dr.opaque(mi.UInt32, seed & 0xFFFFFFFF), dr.opaque(mi.Float, 1.0 / source.scale), window, lanes,
                )  # fmt: skip
                dr.eval(balance)
                for name in total:
                    value = np.array(getattr(balance, name), np.float64).reshape(len(group), -1)
                    total[name] += value.sum(axis=1)
            if pictures is not None:
                images.append(read_images(pictures, shape, walks))
            if powers is not None:
                counts = np.array(powers.total, np.float64).reshape(n, len(group), -1)
                deposits.append(counts * (powers.scale / walks))
        scale = 1.0 / (tags * walks)
        return Traced(
            np.concatenate(images) if images else None,
            np.concatenate(first_half) if first_half else None,
            np.concatenate(deposits) if deposits else None,
            EnergyBalance(**{name: value * scale for name, value in total.items()}),
        )


def stretches(walks: int, step: int) -> Iterator[tuple[int, int]]:
    """(first, number) of at most `step` walks each, all of `walks`; one starts at half of them."""
    for low, high in ((0, walks // 2), (walks // 2, walks)):
        for start in range(low, high, step):
            yield start, min(step, high - start)


def object_field(obj: TwinObject, cells: int) -> DistanceField:
    """Distances to all surfaces; normals of the outer one, through which lobes connect."""
    whole = build_distance_field(obj.mesh, cells)
    if not obj.inside:
        return whole
    walls = [body.mesh.copy() for body in obj.inside]
    for wall, body in zip(walls, obj.inside, strict=True):
        if body.medium is None:  # distances are best on the side that a surface faces away from: where light scatters
            wall.invert()
    every = build_distance_field(trimesh.util.concatenate([obj.mesh, *walls]), cells)
    return replace(every, normal=whole.normal)


def shape_of(name: str, vertices: F64, faces: I64, bsdf: dict[str, Any]) -> mi.Mesh:
    """A Mitsuba mesh with flat (geometric) normals: exact reciprocity, no weight lost to shading."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(name, len(vertices), len(faces), has_vertex_normals=False, props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = to_float(vertices)
    parameters["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
    parameters.update()
    return mesh


def camera_table(cameras: Sequence[PinholeCamera]) -> kernel.Cameras:
    """Rows of `kernel.ROW` floats; see `kernel.Cameras`. All cameras must be of one size."""
    width, height = cameras[0].width, cameras[0].height
    if any((c.width, c.height) != (width, height) for c in cameras):
        raise ValueError("cameras traced together must have the same image size")
    rows = [np.concatenate([c.position, *c.pose[:3, :3], c.focal, c.centre, c.distortion]) for c in cameras]
    return kernel.Cameras(count=len(cameras), width=width, height=height, rows=to_float(np.stack(rows)))


def nearest_factor(cameras: Sequence[PinholeCamera]) -> float:
    """1 / (distance^2 * pixel solid angle) of the nearest camera; without one, 1."""
    return max((float(c.focal.prod() / (c.position @ c.position)) for c in cameras), default=1.0)


def new_images(layers: int, size: int, unit: float) -> kernel.Images:
    """Zeroed accumulators. The quantum is 2^-24 of `unit`, what a photon of usual power adds."""
    quantum = 2.0 ** (np.floor(np.log2(unit)) - 24)
    arrays = [dr.zeros(mi.UInt64, size) for _ in range(2)]
    dr.eval(arrays)
    return kernel.Images(
        layers=layers,
        exits=arrays[0],
        lobes=arrays[1],
        inverse_quantum=dr.opaque(mi.Float, 1 / quantum),
    )


def read_images(images: kernel.Images, shape: tuple[int, ...], walks: int) -> F32:
    """Mean per pixel, of `shape` (..., L, H, W)."""
    quantum = 1 / float(images.inverse_quantum[0])
    mean = (np.array(images.exits) + np.array(images.lobes))[: int(np.prod(shape))].astype(np.float64)
    *front, lasers, height, width = shape
    mean = np.moveaxis((mean * (quantum / walks)).reshape(*front, height, width, lasers), -1, -3)
    return np.ascontiguousarray(mean, np.float32)


def new_deposits(size: int, walks: int) -> kernel.Deposits:
    """Zeroed accumulators of 2^-24 W a count: 2^40 photons of 1 W fit."""
    total = dr.zeros(mi.UInt64, size)
    dr.eval(total)
    return kernel.Deposits(total=total, inverse_quantum=dr.opaque(mi.Float, 2.0**24), scale=2.0**-24)
