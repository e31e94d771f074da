"""`make test` runs every test that is not slow, once: its groups leave out none and share none."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import pytest

MARKS = ("device", "slow", "timing")


def expressions(repository: Path) -> list[str]:
    """What the recipe of `make test` hands to pytest's -m."""
    (recipe,) = re.findall(r"^test:.*\n((?:\t.*\n)+)", (repository / "Makefile").read_text(), re.M)
    return [quoted or word for quoted, word in re.findall(r'-m pytest .*?-m (?:"([^"]+)"|(\w+))', recipe)]


def test_every_fast_test_is_in_one_group(repository: Path) -> None:
    """An expression of -m is one of Python's, whose names say whether a test has the mark."""
    groups = expressions(repository)
    assert len(groups) == 3
    for has in itertools.product((False, True), repeat=len(MARKS)):
        marks = dict(zip(MARKS, has, strict=True))
        if not marks["slow"]:
            assert sum(eval(group, {}, marks) for group in groups) == 1, marks


def test_tests_of_devices_are_marked_by_their_folder(request: pytest.FixtureRequest) -> None:
    """Of all that was collected with this one: those in the rooms of devices, and the rig's commands."""
    for item in request.session.items:
        parts = item.path.parts
        of_devices = "hw" in parts or "emulation" in parts or item.path.name == "test_rig.py"
        assert of_devices == (item.get_closest_marker("device") is not None), item.nodeid
