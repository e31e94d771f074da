"""Seconds and peak memory of a stage, each measured for that stage alone."""

from __future__ import annotations

import logging
import os
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

log = logging.getLogger(__name__)

MIB = 1024.0 * 1024.0


@dataclass
class Usage:
    """Wall-clock seconds and peak resident memory in MiB; complete when the measured block has ended."""

    seconds: float = 0.0
    peak_mb: float = 0.0


@contextmanager
def measured() -> Iterator[Usage]:
    """Measure a block. On Linux its peak is its own; elsewhere it is the process's so far (an upper bound)."""
    usage = Usage()
    try:
        Path("/proc/self/clear_refs").write_text("5")  # Linux: resets the process's high-water mark
    except OSError as error:  # sandboxes may forbid it
        log.debug("the peak of memory counts from the process's beginning: %s", error)
    start = time.perf_counter()
    try:
        yield usage
    finally:
        usage.seconds += time.perf_counter() - start
        usage.peak_mb = max(usage.peak_mb, peak_memory_mb())


def peak_memory_mb() -> float:
    """Peak resident memory of this process in MiB since the last reset."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / 1024.0
    except OSError as error:
        log.debug("%s: asking getrusage instead", error)  # no /proc (macOS)
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest / (MIB if sys.platform == "darwin" else 1024.0)  # in bytes on macOS and in KiB elsewhere


def total_memory_gb() -> float:
    """Physical memory in GiB."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / MIB / 1024.0


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
