"""How much longer a run takes as a whole: its stages as those of scenes/quick.toml, by what the scene asks for, at the
pace of the stages that are done. A guess within a factor of two or three until the capture is done: media differ.
"""

from __future__ import annotations

from disco_twin.scene.scene import DEFAULT_WALKS, Scene
from hw.base.resources import usable_cores

# Seconds on two free cores, and what was asked for.
QUICK_S = {
    "scan": 0.3,
    "targets": 6.0,
    "capture": 68.0,
    "truth": 40.0,
    "references": 0.2,
    "pipeline": 60.0,
    "scores": 1.0,
}
QUICK_WALKS, QUICK_TRUTH, QUICK_SPOTS, QUICK_VERTICES, QUICK_TARGETS = 300 * 20_000, 24 * 100_000, 300, 1596, 2
REFERENCE_S = 43.0  # of a light that is not shipped, in two views
FASTEST, SLOWEST = 0.05, 100.0  # paces that are believed
LEAST_S = 1.0  # expected of a stage whose pace counts


class TimeLeft:
    """missing: lights whose references are to be rendered."""

    def __init__(self, scene: Scene, missing: int = 0) -> None:
        work, spots, cores = scene.simulation, scene.rig.spots, usable_cores()
        size = (scene.scan.vertices or QUICK_VERTICES) / QUICK_VERTICES
        times = {
            "targets": len(scene.rig.cameras) / QUICK_TARGETS,
            "capture": spots * (work.walks_per_spot or DEFAULT_WALKS) / QUICK_WALKS,
            "truth": work.truth_columns * work.truth_walks / QUICK_TRUTH,
            "pipeline": 0.5 * size * (size + spots / QUICK_SPOTS),
        }
        self.expected = {name: seconds * times.get(name, 1.0) * 2 / cores for name, seconds in QUICK_S.items()}
        self.expected["references"] += REFERENCE_S * missing * 2 / cores
        if work.spot_seconds is not None:
            self.expected["capture"] = spots * work.spot_seconds / cores
        self._open, self._took, self._thought = dict(self.expected), 0.0, 0.0

    def finished(self, name: str, seconds: float | None) -> None:
        """A stage has ended. seconds: None where it was finished before, which tells nothing of the pace."""
        thought = self._open.pop(name, 0.0)
        if seconds is not None and thought >= LEAST_S:
            self._took += seconds
            self._thought += thought

    @property
    def pace(self) -> float:
        """Seconds that a stage takes for each that was expected."""
        if not self._thought:
            return 1.0
        return min(max(self._took / self._thought, FASTEST), SLOWEST)

    def seconds(self, name: str | None = None, left_of_it: float = 0.0) -> float:
        """Of the stages to come, and `left_of_it` of the one that is at work."""
        later = sum(seconds for stage, seconds in self._open.items() if stage != name)
        return left_of_it + self.pace * later


def in_words(seconds: float) -> str:
    """As precise as such guesses are."""
    if seconds < 90:
        return f"{5 * round(seconds / 5) or 5} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"
