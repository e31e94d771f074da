"""Emulated devices that do not wait for this computer's processors, as firmware of their own does not."""

from __future__ import annotations

import os

PRIORITY = 5  # real-time: before all ordinary processes, after the supervisors


def come_first() -> bool:
    """Give the calling thread, and all that it starts, this priority; whether the system allows it."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (OSError, AttributeError):
        return False
    return True
