"""`make test` runs every test that is not slow, once: its groups leave out none and share none."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import pytest


def test_every_fast_test_is_in_one_group(repository: Path) -> None:
    """A test of devices is one that stands in the folders that the first two groups look in.

    An expression of pytest's -m is one of Python's, whose names say whether a test has the mark.
    """
    makefile = (repository / "Makefile").read_text()
    (recipe,) = re.findall(r"^test:.*\n((?:\t.*\n)+)", makefile, re.M)
    groups = re.findall(r'-m pytest (\$\(DEVICES\) )?.*?-m (?:"([^"]+)"|(\w+))', recipe)
    assert len(groups) == 3
    for device, slow, timing in itertools.product((False, True), repeat=3):
        marks = {"device": device, "slow": slow, "timing": timing}
        runs = [eval(quoted or word, {}, marks) for where, quoted, word in groups if device or not where]
        if not slow and (device or not timing):  # tests/conftest.py refuses tests of timing that are not of devices
            assert sum(runs) == 1, marks


def test_tests_of_devices_are_marked_by_their_folder(repository: Path, request: pytest.FixtureRequest) -> None:
    """Of all that was collected with this one, those in the folders that `make test` looks for them in."""
    (listed,) = re.findall(r"^DEVICES := (.*)$", (repository / "Makefile").read_text(), re.M)
    folders = [repository / name for name in listed.split()]
    assert all(folder.exists() for folder in folders)
    for item in request.session.items:
        of_devices = any(item.path.is_relative_to(folder) for folder in folders)
        assert of_devices == (item.get_closest_marker("device") is not None), item.nodeid
