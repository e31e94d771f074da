"""The simulated DISCO rig: objects, light, cameras, ground truth, reports and the command line."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from disco_twin.evaluate.opened_run import OpenedRun


def open_run(folder: str | Path) -> OpenedRun:
    """A run folder's content as arrays with named axes and units; needs no renderer (docs/howto/write-a-method.md).

    Raises: InputError for a folder that is no run, and, from what is asked for, where its stage is not finished.
    """
    # Imported by name: what this package imports would belong to the keys of all stages, simulated light among them.
    opened: OpenedRun = import_module("disco_twin.evaluate.opened_run").OpenedRun(Path(folder))
    return opened
