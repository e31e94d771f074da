"""The capture loop: drives a rig through a plan, image by image, into a stream, by the interface alone.

Gates are shut during every move, and one at most is open. The clock is restored on resuming, and with it the state of
turntable and projector, so that a capture that was interrupted ends with the very bytes of one that was not.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Self

from hw.base.errors import DiscoError, InputError
from hw.interface import Rig, gate_open
from hw.record import RawImage, Sensor
from hw.safety.signals import interruptible, raise_if_interrupted, uninterrupted
from pipeline.capture.laser_log import DRIFT_SHARE, append_lasers, drifts, read_lasers
from pipeline.capture.unmoved import require_unmoved
from pipeline.plan.plan import ImageAddress, Plan
from pipeline.stream.layout import ImageMeta
from pipeline.stream.stream import StreamReader, StreamWriter

log = logging.getLogger(__name__)

SMALL = 1 << 15  # pixels of an image that is stored sooner than it is handed over

Progress = Callable[[int, int], None]  # images stored, images of the plan


class Interrupted(DiscoError):
    """The user asked to stop; every image that was reported as stored is."""


def capture(rig: Rig, plan: Plan, folder: Path, progress: Progress | None = None, sensor: Sensor | None = None) -> int:
    """Take the images of the plan that are not yet stored in the folder; how many were there before.

    The rig is safe whenever this ends.

    Ctrl-C (or another signal of `hw.safety.signals`) is obeyed at once, since lasers must go out: the image in progress
    is dropped, to be taken again, and `Interrupted` raised. The folder of another plan is refused before the rig is
    switched on.
    With a `sensor`, a rig that has moved since the capture was interrupted is refused (`pipeline.capture.unmoved`).
    """
    _require_match(rig, plan)
    with StreamWriter(folder, plan) as stream:
        resumed_at = len(stream)
        if not stream.complete:
            log.info("capture: image %d of %d into %s", resumed_at, len(plan), folder)
            with interruptible() as interruption:
                try:
                    with Storing(stream, progress) as storing, rig:
                        _restore(rig, stream, sensor)
                        _sweep(rig, stream, storing)
                except KeyboardInterrupt:
                    raise _interrupted(stream) from None
                except DiscoError:
                    if interruption.stopped:  # what fails on the way out does not matter any more
                        raise _interrupted(stream) from None
                    raise
                finally:
                    interruption.ignoring = True
                    rig.make_safe()  # once more: entering the rig may have failed half-way, leaving it been interrupted
    return resumed_at


def _require_match(rig: Rig, plan: Plan) -> None:
    names = tuple(camera.name for camera in rig.cameras)
    if names != plan.cameras:
        raise InputError("the plan is for other cameras", key="cameras", value=names, allowed=str(plan.cameras),
                         remedy="name the rig's cameras as the plan does")  # fmt: skip
    if len(rig.lasers) != plan.lasers:
        raise InputError("the plan is for other lasers", key="lasers", value=len(rig.lasers), allowed=str(plan.lasers),
                         remedy="use the rig that the plan was made for")  # fmt: skip


class Storing:
    """Stores each image while the next one is exposed: encoding takes half a frame, and nothing else is done then.

    Leaving it stores the last image, whatever ended the block; the rig is dark by then.
    """

    def __init__(self, stream: StreamWriter, progress: Progress | None) -> None:
        self._stream, self._progress = stream, progress
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="store")
        self._taken: tuple[ImageAddress, RawImage, ImageMeta] | None = None
        self._stored: Future[None] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        with uninterrupted(), self._worker:
            try:
                self.finish()
            except DiscoError as refused:  # the disk; where another error has ended the block, that is the reason
                if error is None:
                    raise
                log.error("%s", refused)

    def put(self, address: ImageAddress, raw: RawImage, meta: ImageMeta) -> None:
        """Keep an image that was taken, once the one before is stored; a small one is stored at once.

        Raises: StorageError, of the one before, or of this one.
        """
        self.finish()
        if raw.charge.size >= SMALL:
            self._taken = (address, raw, meta)
            return
        with uninterrupted():
            self._stream.append(address, raw, meta)
        self._report()

    def begin(self) -> None:
        """Store what was taken, in the background."""
        taken, self._taken = self._taken, None
        if taken is not None:
            self._stored = self._worker.submit(self._stream.append, *taken)

    def finish(self) -> None:
        """Wait until everything is stored, and report it. Raises: StorageError."""
        self.begin()
        if self._stored is not None:  # kept while it is waited for: Ctrl-C must not hide what becomes of it
            try:
                self._stored.result()
            except DiscoError:
                self._stored = None
                raise
            self._stored = None
            self._report()

    def _report(self) -> None:
        if self._progress is not None:
            self._progress(len(self._stream), len(self._stream.plan))


def _sweep(rig: Rig, stream: StreamWriter, storing: Storing) -> None:
    plan = stream.plan
    announced = checked = None
    for index in range(len(stream), len(plan)):
        raise_if_interrupted()
        address = plan.address(index)
        if checked != address.view:
            _check_lasers(rig, stream, address.view)
            checked = address.view
        if address.kind == "silhouette":
            rig.turntable.move(plan.angles_rad[plan.angle_of(address.view)])
        if address.kind == "spot" and announced != address.view:
            rig.announce([plan.spots[i] for i in plan.spots_at(plan.angle_of(address.view))])
            announced = address.view
            raise_if_interrupted()
        storing.put(address, *_take(rig, plan, address, storing.begin))


def _check_lasers(rig: Rig, stream: StreamWriter, view: int) -> None:
    """Before a view, in the dark; what is beyond the rig's tolerance is refused by the rig, what drifts is marked."""
    readings = rig.check()
    with uninterrupted():
        append_lasers(stream.folder, view, rig.now(), readings)
    drift = drifts(read_lasers(stream.folder)).get(view, 0.0) if readings else 0.0
    if drift > DRIFT_SHARE:
        log.warning("view %d: a laser's own reading is %.1f %% off its first one", view, 100 * drift)


def _restore(rig: Rig, stream: StreamWriter, sensor: Sensor | None) -> None:
    """Bring rig and clock to where they were when the last stored image was complete."""
    meta = stream.last_meta()
    if meta is None:
        return
    if sensor is not None:
        with StreamReader(stream.folder) as stored:
            require_unmoved(rig, stored, sensor)
    raise_if_interrupted()
    rig.turntable.move(meta.angle_rad)
    # After a silhouette the mirrors still stand where the last spot of the view before it left them.
    backwards = (stream.plan.address(i).spot for i in range(len(stream) - 1, -1, -1))
    spot = next((spot for spot in backwards if spot >= 0), None)
    if spot is not None:
        rig.projector.move(stream.plan.spots[spot].u, stream.plan.spots[spot].v)
    rig.resume_at(meta.time_s)


def _take(rig: Rig, plan: Plan, address: ImageAddress, exposing: Callable[[], None]) -> tuple[RawImage, ImageMeta]:
    """One image and the rig's state; the time is read last, when nothing of this image remains to be done.

    exposing: is called when everything is set and the exposure begins
    """
    camera = rig.cameras[plan.camera_of(address.view)]
    angle = plan.angles_rad[plan.angle_of(address.view)]
    if address.kind == "silhouette":
        try:
            rig.floodlight.on()
            exposing()
            raw = camera.expose()
        finally:
            rig.floodlight.off()
        return raw, ImageMeta(rig.now(), 0.0, angle, -1, -1)
    aim = plan.spots[address.spot]
    if address.laser == 0:
        rig.projector.move(aim.u, aim.v)
    with gate_open(rig.lasers[address.laser]):
        exposing()
        raw = camera.expose()
        power = rig.photodiode.read()
    return raw, ImageMeta(rig.now(), power, angle, aim.u, aim.v)


def _interrupted(stream: StreamWriter) -> Interrupted:
    done, total = len(stream), len(stream.plan)
    return Interrupted(f"stopped: {done} of {total} images are stored; the same command continues")
