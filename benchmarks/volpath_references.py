"""References by stock Mitsuba (`volpath`, no roulette): `python -m benchmarks.volpath_references [--most 6]`.

Renders those of `WANTED` that are missing beside their scenes, in passes that are kept in `--work`: a call that is
stopped, or that ends after `--most` passes of a half, is continued by the next. Afterwards, or with --compare, each is
compared with our own reference of the same light and view.

Layers as ours have them: what the surface reflects is the image of the same object with a black inside, what comes from
below is the image of the object less that. The halves are independent of each other in both.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from benchmarks.block_z import BlockZ, z_of_blocks
from disco_twin.experiment.references import (
    holds_outside_reference,
    outside_folder,
    reference_key,
    reference_path,
    shipped_references,
)
from disco_twin.light.references import HALVES, LAYERS, Reference, load_reference, noise_of, save_reference
from disco_twin.object.build import TwinObject, build_object
from disco_twin.scene.scene import Scene, load_scene
from hw.base.arrays import F64
from hw.base.files import load_arrays, save_arrays
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.relight.lights import Environment, Uniform

ROOT = Path(__file__).parents[1]
PASS = 16  # samples of every pixel in one pass of a half
BLACK_PASSES = 4  # passes of the black object for each of the object: its paths are short
BLACK = 100.0  # times sigma_t, of the object that is black inside
VARIANT = "llvm_ad_rgb"
VERSION = 2  # of the file that holds passes


@dataclass(frozen=True)
class Wanted:
    """References under a light of a scene, in some of its held-out views, of so many passes a half."""

    scene: str
    light: str
    passes: int
    views: tuple[str, ...] = ("left", "right")

    @property
    def file(self) -> Path:
        return ROOT / "scenes" / self.scene


WANTED = (
    Wanted("accuracy/score/bracket.toml", "uniform", 12),
    Wanted("accuracy/score/bracket.toml", "environment", 48),
    Wanted("quick.toml", "uniform", 3),
    Wanted("quick.toml", "environment", 1, ("left",)),
)


@dataclass(frozen=True)
class Job:
    """One image: the scene, a light and a view; `folder` holds the scene's ordinary references."""

    scene: Scene
    light: Uniform | Environment
    view: CameraConfig
    passes: int
    folder: Path

    @cached_property
    def obj(self) -> TwinObject:
        """What is rendered."""
        return build_object(self.scene)

    @property
    def name(self) -> str:
        return f"{self.scene.name} {self.light.name}@{self.view.name}"

    @property
    def path(self) -> Path:
        return reference_path(outside_folder(self.folder), self.light, self.view)

    @property
    def key(self) -> str:
        return reference_key(self.scene, self.light, self.view)

    def ours(self) -> Reference:
        """The ordinary reference."""
        return load_reference(reference_path(self.folder, self.light, self.view))


@dataclass
class Passes:
    """What has been rendered of a job: sums (half, layer, row, column, laser) over the `done` passes of both halves."""

    sums: F64
    done: int = 0
    seconds: float = 0.0  # of processor time

    @property
    def mean(self) -> F64:
        """Radiance, with the axes of `sums`; halves take turns."""
        each = [(self.done + 1 - half) // len(HALVES) for half in range(len(HALVES))]
        return np.asarray(self.sums / np.array(each)[:, None, None, None, None])

    def enough(self, job: Job) -> bool:
        """Whether that is all."""
        return self.done >= len(HALVES) * job.passes


def jobs() -> Iterator[Job]:
    """Everything that is wanted."""
    for wanted in WANTED:
        scene = load_scene(wanted.file)
        light = next(light for light in scene.relight.lights if light.name == wanted.light)
        assert isinstance(light, Uniform | Environment)  # others are met by no path that leaves
        folder = shipped_references(wanted.file, scene.name)
        for view in (view for view in scene.relight.views if view.name in wanted.views):
            yield Job(scene, light, view, wanted.passes, folder)


def render(job: Job, work: Path, most: int) -> int:
    """Render at most so many passes of a half, and the reference once there are enough; how many were rendered."""
    from benchmarks.volpath import DEPTH, FINER

    camera = PinholeCamera.from_config(job.view)
    left, top, width, height = object_window(job.obj, camera)
    kept, how = work / f"{job.name}.npz".replace(" ", "-"), [job.key, PASS, DEPTH, FINER]
    passes = Passes(np.zeros((len(HALVES), len(LAYERS), height, width, 3)))
    if kept.is_file():
        head, arrays = load_arrays(kept, VERSION, "delete it")
        if head["how"] == how:
            passes = Passes(arrays["sums"], head["done"], head["seconds"])
    before = passes.done
    if most and not passes.enough(job):
        for _ in itertools.islice(rendered(job, camera, passes), most):
            work.mkdir(parents=True, exist_ok=True)
            save_arrays(kept, VERSION, {"sums": passes.sums}, how=how, done=passes.done, seconds=passes.seconds)
    print(f"{job.name}: {passes.done} of {2 * job.passes} passes, {passes.seconds:.0f} s of processor time", flush=True)
    if passes.enough(job):
        halves = np.zeros((len(HALVES), len(LAYERS), 3, camera.height, camera.width), np.float32)
        halves[..., top : top + height, left : left + width] = np.moveaxis(passes.mean, -1, 2)
        save_reference(job.path, Reference(halves, noise_of(halves), job.key))
    return passes.done - before


def rendered(job: Job, camera: PinholeCamera, passes: Passes) -> Iterator[None]:
    """Render on, half by half in turn, into `passes`."""
    import mitsuba as mi

    from benchmarks.volpath import volpath_scene

    medium, window = job.obj.medium, object_window(job.obj, camera)
    black = replace(job.obj, medium=replace(medium, sigma_t=BLACK * medium.sigma_t, albedo=0 * medium.albedo))
    with tempfile.TemporaryDirectory() as folder:
        whole, shine = (
            volpath_scene(obj, camera, job.light, Path(folder), window, connect=False) for obj in (job.obj, black)
        )
        while not passes.enough(job):
            start = time.process_time()
            number, half = divmod(passes.done, len(HALVES))
            image, surface = (
                np.array(mi.render(scene, spp=count * PASS, seed=seed(job, number, half, k)), np.float64)
                for k, (scene, count) in enumerate(((whole, 1), (shine, BLACK_PASSES)))
            )
            passes.sums[half, LAYERS.index("subsurface")] += image - surface
            passes.sums[half, LAYERS.index("surface")] += surface
            passes.done += 1
            passes.seconds += time.process_time() - start
            yield


def seed(job: Job, number: int, half: int, layer: int) -> int:
    """Of its own for each render."""
    tree = np.random.SeedSequence([job.scene.seed, zlib.crc32(job.name.encode()), number, half, layer])
    return int(tree.generate_state(1)[0])


def object_window(obj: TwinObject, camera: PinholeCamera) -> tuple[int, int, int, int]:
    """Left, top, width, height of the part of a picture that holds the whole object."""
    where, _ = camera.project(np.asarray(obj.mesh.vertices, np.float64))
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(where.min(axis=0)).astype(int), 0, size - 1)
    high = np.clip(np.ceil(where.max(axis=0)).astype(int), low + 1, size)
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def comparisons(job: Job) -> dict[str, BlockZ]:
    """z-scores of the sum of both layers, and of each."""
    ours, theirs = (np.asarray(r.halves, np.float64) for r in (job.ours(), load_reference(job.path)))
    found = {"sum": z_of_blocks(ours.sum(axis=1), theirs.sum(axis=1))}
    return found | {name: z_of_blocks(ours[:, k], theirs[:, k]) for k, name in enumerate(LAYERS)}


def compare(job: Job) -> None:
    """Print them."""
    found = load_reference(job.path)
    print(f"{job.name}: noise {100 * noise_of(found.halves):.1f} %, ours {100 * noise_of(job.ours().halves):.1f} %")
    for name, z in comparisons(job).items():
        rms, beyond = np.sqrt((z.blocks**2).mean()), (np.abs(z.blocks) > 3).mean()
        level = ", ".join(f"{r:.4f} +- {e:.4f}" for r, e in zip(z.ratio, z.ratio_se, strict=True))
        print(
            f"  {name:<10} {z.blocks.shape[1]} blocks: rms {rms:.2f}, largest {np.abs(z.blocks).max():.2f}, "
            f"beyond 3 {100 * beyond:.1f} %; whole image {np.round(z.whole, 2)}, ours over theirs {level}"
        )


def main(arguments: list[str] | None = None) -> int:
    """Exit status 3 where some are still missing."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.volpath_references", description=__doc__)
    parser.add_argument("--most", type=int, default=sys.maxsize, help="passes of a half in this call")
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "volpath", help="where passes are kept")
    parser.add_argument("--compare", action="store_true", help="render nothing")
    options = parser.parse_args(arguments)
    most, complete = options.most, True
    if not options.compare:
        from disco_twin.light.backend import activate

        activate()  # finds LLVM
        import mitsuba as mi

        mi.set_variant(VARIANT)
    for job in jobs():
        if not holds_outside_reference(job.folder, job.scene, job.light, job.view):
            most -= 0 if options.compare else render(job, options.work, most)
        if holds_outside_reference(job.folder, job.scene, job.light, job.view):
            compare(job)
        else:
            complete = False
    return 0 if complete else 3


if __name__ == "__main__":
    sys.exit(main())
