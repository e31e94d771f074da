"""A grabber over `viva-genicam` (the extra `genicam`): GigE Vision and USB3 Vision cameras, by software trigger.

A trigger ties a frame to its exposure; in free run a change of exposure reaches the pixels some frames later, and how
many is the camera's secret. Where the camera can, every frame also carries its exposure (a chunk) as a witness.
"""

from __future__ import annotations

import importlib
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from hw.base.errors import InputError
from hw.camera.genicam import CameraError, CameraFrame, FrameLost

log = logging.getLogger(__name__)

HEARTBEAT_S = 10.0  # cameras wait 3 s by default for a sign of life
SLICE_MS = 20  # a wait is cut into these, so that Ctrl-C is obeyed
CABLE = ". Remedy: check its cable and power"
OFF = ("ExposureAuto", "GainAuto", "BlackLevelAuto", "BalanceWhiteAuto")  # what would make the sensor non-linear


def _client() -> Any:
    try:
        return importlib.import_module("viva_genicam")
    except ImportError as error:
        remedy = "pip install 'disco-twin[genicam]'"
        raise InputError("the camera needs the package viva-genicam", remedy=remedy) from error


def discover() -> list[str]:
    """Every camera in reach, one line each."""
    vg = _client()
    gige = [f"GigE {d.ip} {d.manufacturer or ''} {d.model or ''}".strip() for d in vg.discover(1000, all=True)]
    usb = [f"USB3 {d.serial or ''} {d.manufacturer or ''} {d.model or ''}".strip() for d in _on_usb(vg)]
    return gige + usb


def _on_usb(vg: Any) -> list[Any]:
    try:
        return list(vg.discover_u3v())
    except vg.TransportError as error:  # a machine without USB
        log.info("no USB cameras: %s", error)
        return []


class VivaGrabber:
    """`hw.camera.genicam.Grabber`. address: IP of a GigE camera, or the serial number of a USB3 one."""

    def __init__(self, address: str, pixel_format: str, size: tuple[int, int], *, serial: str | None = None) -> None:
        self._vg = _client()
        self._address = address
        self._stream: Any = None
        with self._errors():
            self._camera = self._connect(address)
            try:
                self._refuse_other(serial)
                self._configure(pixel_format, size)
                self._open_stream()
            except BaseException:
                self.close()
                raise

    @contextmanager
    def _errors(self, remedy: str = "") -> Iterator[None]:
        """Errors of the client as ours."""
        try:
            yield
        except self._vg.GenicamError as error:
            raise CameraError(f"camera {self._address}: {error}{remedy}") from error

    def _connect(self, address: str) -> Any:
        vg = self._vg
        for _ in range(3):  # discovery is a broadcast, which is not repeated when it is lost
            found = [d for d in vg.discover(1000, all=True) if d.ip == address]
            if found:
                return self._claim(found[0])
        found = [d for d in _on_usb(vg) if d.serial == address]
        if found:
            return vg.connect_u3v(found[0])
        raise CameraError(
            f"camera {address} does not answer; in reach are: {', '.join(discover()) or 'none'}. Remedy: check power, "
            "cable and address; one program at a time can control a camera"
        )

    def _claim(self, device: Any) -> Any:
        """Take control; a program that was killed keeps it until its heartbeat is missed."""
        end = time.monotonic() + HEARTBEAT_S
        while True:
            try:
                return self._vg.connect_gige(device)
            except self._vg.GenicamError as error:
                if "ACCESS_DENIED" not in str(error) or time.monotonic() > end:
                    raise
                log.info("camera %s is controlled by another program; waiting", self._address)
                time.sleep(0.5)

    def _refuse_other(self, serial: str | None) -> None:
        found = self._camera.get("DeviceSerialNumber") if self._has("DeviceSerialNumber") else None
        if serial is not None and found != serial:
            remedy = "correct its address, or its serial if it was exchanged"
            raise InputError(f"the camera at {self._address} is another one", key="serial", value=serial, allowed=found,
                             remedy=remedy)  # fmt: skip

    def _has(self, name: str) -> bool:
        return self._camera.node_info(name) is not None

    def _configure(self, pixel_format: str, size: tuple[int, int]) -> None:
        """Make it a linear sensor that exposes at a trigger, with nothing automatic about it."""
        camera = self._camera
        for name in OFF:
            if self._has(name):
                camera.set_enum(name, "Off")
        if self._has("GammaEnable"):
            camera.set_bool("GammaEnable", False)
        self._set_format(pixel_format)
        for name, value in zip(("Height", "Width"), size, strict=True):
            if camera.get_integer(name) != value:
                camera.set_integer(name, value)
        camera.set_enum("AcquisitionMode", "Continuous")
        camera.enable_trigger("FrameStart", "Software")
        self._chunks = self._has("ChunkExposureTime")
        if self._chunks:
            camera.configure_chunks(["ExposureTime"])
        ticks = camera.get_integer("GevTimestampTickFrequency") if self._has("GevTimestampTickFrequency") else 0
        self._tick_s = 1.0 / (ticks or 1e9)  # USB3 Vision counts nanoseconds

    def _set_format(self, wanted: str) -> None:
        entries = self._camera.enum_entries("PixelFormat")
        if wanted in entries:
            self._camera.set_enum("PixelFormat", wanted)
        elif not any(entry.startswith(("Mono10", "Mono12", "Mono14", "Mono16")) for entry in entries):
            raise InputError("the camera has no deep Mono format", key="pixel_format", value=wanted,
                             allowed=", ".join(entries), remedy="take a camera with more than 8 bits")  # fmt: skip
        # Some cameras send a format that their own XML leaves out: the frames say what they are, and `grab` checks it.
        self._format = wanted

    def _open_stream(self) -> None:
        stream = self._camera.stream(deliver_incomplete=True)
        stream.__enter__()
        self._stream = stream

    def identity(self) -> str:
        """Vendor, model and serial number."""
        names = ("DeviceVendorName", "DeviceModelName", "DeviceSerialNumber")
        return " ".join(self._camera.get(name) for name in names if self._has(name))

    def set_exposure(self, seconds: float) -> float:
        """Ask for an exposure; what the camera made of it. Raises: InputError, CameraError."""
        try:
            self._camera.set_exposure_time(seconds * 1e6)
            return float(self._camera.exposure_time()) * 1e-6
        except self._vg.GenApiError as error:
            limits = self._camera.feature_state("ExposureTime").range
            allowed = None if limits is None else f"{limits.min:g} to {limits.max:g} us"
            problem = f"camera {self._address} refuses an exposure of {seconds * 1e6:g} us ({error})"
            key, remedy = "sensor.longest_exposure_s", "correct sensor.longest_exposure_s and sensor.exponents"
            raise InputError(problem, key=key, allowed=allowed, remedy=remedy) from error
        except self._vg.GenicamError as error:
            raise CameraError(f"camera {self._address}: {error}") from error

    def grab(self, timeout_s: float) -> CameraFrame:
        """One frame by software trigger. Raises: FrameLost, InputError, CameraError."""
        with self._errors(CABLE):
            self._camera.trigger_software()
            frame = self._next(timeout_s)
            if not frame.is_complete:
                raise FrameLost(f"{frame.status.value}, {frame.missing_packets or 'unknown'} packets missing")
            if frame.pixel_format != self._format:
                raise InputError("the camera sends another format", key="pixel_format", value=self._format,
                                 allowed=frame.pixel_format, remedy="name the format that it sends")  # fmt: skip
            exposure = float(self._camera.chunk_features(frame)["ChunkExposureTime"]) * 1e-6 if self._chunks else None
            pixels = np.asarray(frame.to_numpy(), np.uint16)
        if frame.ts_dev is None:
            remedy = "take one that does, or newer firmware"
            raise CameraError(f"camera {self._address} sends no timestamps. Remedy: {remedy}")
        return CameraFrame(pixels, frame.ts_dev * self._tick_s, exposure)

    def _next(self, timeout_s: float) -> Any:
        end = time.monotonic() + timeout_s
        while True:
            begun = time.monotonic()
            if begun >= end:
                raise FrameLost(f"nothing arrived within {timeout_s:.2f} s")
            try:
                frame = self._stream.next_frame(SLICE_MS)
            except self._vg.TransportError:
                if time.monotonic() - begun < 0.5e-3 * SLICE_MS:
                    raise  # not the slice that ran out: the link is broken
                continue
            if frame is None:
                raise FrameLost("the stream ended")
            return frame

    def restart(self) -> None:
        """Stop and start the acquisition."""
        with self._errors(CABLE):
            stream, self._stream = self._stream, None
            if stream is not None:
                stream.__exit__(None, None, None)
            self._open_stream()

    def close(self) -> None:
        """Stop the acquisition and give control back."""
        try:
            if self._stream is not None:
                self._stream.__exit__(None, None, None)
            self._camera.close()
        except self._vg.GenicamError as error:
            log.warning("camera %s: closing failed: %s", self._address, error)
