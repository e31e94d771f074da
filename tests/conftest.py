"""What all tests share: no display, the repository's paths, which tests are of devices, which files come first."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import hypothesis
import pytest

os.environ.setdefault("MPLBACKEND", "Agg")
# A shell starts background jobs with SIGINT and SIGQUIT ignored, nohup with SIGHUP, and programs hand that on to their
# children; the tests and their children are to take all three as from a terminal.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
signal.signal(signal.SIGQUIT, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)
# How long an example takes says how busy the machine is, and nothing of the code.
hypothesis.settings.register_profile(
    "disco-twin", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("disco-twin")


LONGEST_FIRST = ("regression", "validation", "system")  # folders of tests; nobody waits at the end for one long file
DEVICES = (  # tests that wait in real time: for devices, and for the disk
    "unit/hw", "unit/disco_twin/emulation", "unit/pipeline/capture/test_loop.py", "system/test_rig.py",
)  # fmt: skip


@pytest.hookimpl(tryfirst=True)  # before `-m` chooses by marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of devices; put the files that take longest first.

    Raises: pytest.UsageError where a laser's timing is tested elsewhere: `make test` looks for it there alone.
    """
    here = Path(__file__).parent
    places = {name: k for k, name in enumerate(LONGEST_FIRST)}
    items.sort(key=lambda item: places.get(item.path.relative_to(here).parts[0], len(places)))
    for item in items:
        if any(item.path.is_relative_to(here / place) for place in DEVICES):
            item.add_marker("device")
        elif item.get_closest_marker("timing"):
            raise pytest.UsageError(f"{item.nodeid} is of timing, but stands in none of {DEVICES}")


@pytest.fixture(scope="session")
def repository() -> Path:
    """The checkout that the tests run in."""
    return Path(__file__).resolve().parents[1]
