"""Is a capture good? Figures of every view, from the stream and the sensor alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from hw.record import Sensor, to_radiance
from pipeline.capture.laser_log import DRIFT_SHARE, drifts, read_lasers
from pipeline.stream.stream import CorruptImage, StreamReader

SIGNIFICANT = 5.0  # standard deviations: a pixel that shows light
DARK_PIXELS = 20  # a spot with fewer significant pixels shows nothing


@dataclass(frozen=True)
class ViewQuality:
    """One view. Shares of all its spot images' pixels; range_db: brightest against dimmest significant radiance.

    dark: spots (of `spots`) that show hardly any light in any laser; power_w, power_spread: mean of the photodiode and
    its standard deviation as a share, one value a laser; own_drift: by how much a laser's own reading was off its first
    one before this view, as a share.
    """

    view: int
    camera: str
    angle_rad: float
    stored: int
    planned: int
    damaged: int
    saturated: float
    significant: float
    range_db: float
    spots: int
    dark: int
    power_w: tuple[float, ...]
    power_spread: tuple[float, ...]
    own_drift: float = 0.0

    @property
    def remarks(self) -> list[str]:
        """What somebody should look into."""
        drift = max((s for s in self.power_spread if np.isfinite(s)), default=0.0)
        return [
            text
            for condition, text in (
                (self.stored < self.planned, f"{self.planned - self.stored} images not taken yet"),
                (self.damaged > 0, f"{self.damaged} images damaged"),
                (self.saturated > 1e-3, "saturated: a shorter exposure or less light"),
                (self.dark > 0.5 * self.spots, "most spots are dark here: is the object in sight and in focus?"),
                (drift > 0.1, f"laser power varies by {100 * drift:.0f} %"),
                (self.own_drift > DRIFT_SHARE, f"a laser's own reading has drifted by {100 * self.own_drift:.1f} %"),
            )
            if condition
        ]


def examine(stream: StreamReader, sensor: Sensor) -> Iterator[ViewQuality]:
    """View by view, in the order of the capture."""
    plan, index = stream.plan, 0
    drift = drifts(read_lasers(stream.folder))
    for view in range(plan.views):
        spots = plan.spots_at(plan.angle_of(view))
        planned = 1 + plan.lasers * len(spots)
        yield replace(_view(stream, sensor, view, index, planned), own_drift=drift.get(view, 0.0))
        index += planned


def _view(stream: StreamReader, sensor: Sensor, view: int, first: int, planned: int) -> ViewQuality:
    plan = stream.plan
    stored = int(np.clip(len(stream) - first, 0, planned))
    powers: list[list[float]] = [[] for _ in range(plan.lasers)]
    damaged = pixels = saturated = significant = 0
    low, high = np.inf, 0.0
    lit: dict[int, int] = {}
    for index in range(first, first + stored):
        address = plan.address(index)
        try:
            if address.kind == "silhouette":
                stream.read(index)
                continue
            image = to_radiance(stream.read(index), sensor, address.laser)
            powers[address.laser].append(stream.meta(index).photodiode_w)
        except CorruptImage:
            damaged += 1
            continue
        sure = (image.radiance > SIGNIFICANT * np.sqrt(image.variance)) & ~image.saturated
        count = int(np.count_nonzero(sure))
        lit[address.spot] = max(lit.get(address.spot, 0), count)
        pixels, saturated, significant = pixels + sure.size, saturated + int(image.saturated.sum()), significant + count
        if count:
            low = min(low, float(image.radiance[sure].min()))
            high = max(high, float(image.radiance[sure].max()))
    means = [float(np.mean(p)) if p else float("nan") for p in powers]
    return ViewQuality(
        view,
        plan.cameras[plan.camera_of(view)],
        plan.angles_rad[plan.angle_of(view)],
        stored,
        planned,
        damaged,
        saturated / max(1, pixels),
        significant / max(1, pixels),
        20.0 * float(np.log10(high / low)) if high > 0 else 0.0,
        len(lit),
        sum(count < DARK_PIXELS for count in lit.values()),
        tuple(means),
        tuple(float(np.std(p)) / m if p and m else float("nan") for p, m in zip(powers, means, strict=True)),
    )
