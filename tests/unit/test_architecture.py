"""docs/architecture.md names every room and no other; modules and tests stand in rooms; packages state a purpose."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import pytest

LOOSE = {  # the only modules that stand in no room
    "hw": {"__init__", "interface", "record"},
    "pipeline": {"__init__", "__main__", "records", "run"},
    "disco_twin": {"__init__", "__main__"},
}
FLOORS = tuple(LOOSE)
SCREEN = 60  # lines


def packages(repository: Path, floor: str) -> set[str]:
    """Names of a floor's packages relative to it, such as "reconstruct/samples"."""
    root = repository / floor
    return {path.parent.relative_to(root).as_posix() for path in root.rglob("__init__.py")} - {"."}


def page(repository: Path) -> str:
    """The text of docs/architecture.md."""
    return (repository / "docs" / "architecture.md").read_text()


@pytest.mark.parametrize("floor", FLOORS)
def test_the_page_names_every_room_and_no_other(repository: Path, floor: str) -> None:
    """A floor's rooms are listed below its name: `room/` first in an indented line, rooms in rooms anywhere in one."""
    (listed,) = re.findall(rf"^{floor}/ .*\n((?:  .*\n)*)", page(repository), re.M)
    rooms = re.findall(r"^  ([a-z0-9_]+)/ ", listed, re.M)
    assert len(set(rooms)) == len(rooms)
    assert set(rooms) | set(re.findall(r"\b[a-z0-9_]+/[a-z0-9_]+(?=/)", listed)) == packages(repository, floor)


@pytest.mark.parametrize("floor", FLOORS)
def test_the_page_lists_rooms_in_the_order_in_which_they_import(repository: Path, floor: str) -> None:
    contracts = tomllib.loads((repository / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (layers,) = (c["layers"] for c in contracts if c.get("containers") == [floor])
    level = {room.strip(): -n for n, layer in enumerate(layers) for room in layer.split("|")}
    (listed,) = re.findall(rf"^{floor}/ .*\n((?:  .*\n)*)", page(repository), re.M)
    levels = [level[room] for room in re.findall(r"^  ([a-z0-9_]+)/ ", listed, re.M)]
    assert levels == sorted(levels)


def test_the_page_fits_a_screen_and_its_paths_exist(repository: Path) -> None:
    text = page(repository)
    assert len(text.splitlines()) <= SCREEN
    paths = re.findall(r"`((?:hw|pipeline|disco_twin|benchmarks|docs|scenes)/[^` ]*)`", text)
    paths += [f"docs/{link}" for link in re.findall(r"\]\(([^)#]+)\)", text)]
    assert len(paths) > 10
    assert [path for path in paths if not (repository / path).exists()] == []


@pytest.mark.parametrize("floor", FLOORS)
def test_modules_stand_in_rooms(repository: Path, floor: str) -> None:
    assert {path.stem for path in (repository / floor).glob("*.py")} <= LOOSE[floor]
    files = list((repository / floor).rglob("*.py"))
    assert [path for path in files if not (path.parent / "__init__.py").exists()] == []


@pytest.mark.parametrize("floor", FLOORS)
def test_every_package_states_what_it_is_for(repository: Path, floor: str) -> None:
    """Its docstring begins with a sentence of several words: no path, no name alone."""
    for name in packages(repository, floor) | {"."}:
        text = ast.get_docstring(ast.parse((repository / floor / name / "__init__.py").read_text())) or ""
        first = text.split("\n\n")[0]
        assert re.fullmatch(r"[A-Z`].*\.", first, re.S), (floor, name, first)
        assert len(first.split()) >= 4, (floor, name, first)


@pytest.mark.parametrize("floor", FLOORS)
def test_unit_tests_stand_as_the_packages_do(repository: Path, floor: str) -> None:
    root = repository / "tests" / "unit" / floor
    folders = {path.parent.relative_to(root).as_posix() for path in root.rglob("test_*.py")} - {"."}
    assert folders <= packages(repository, floor)
