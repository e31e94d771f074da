"""What surrounds the program: folders that it is called in, terminals, empty names, signals, its own children."""

from __future__ import annotations

import io
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.console import Console

import hw
from disco_twin.cli import app, start
from disco_twin.run.progress import stage_bar
from hw.base.children import ROOT, child_environment, code_command, module_command


@pytest.fixture
def traps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current folder full of modules that have our names, and Python's own."""
    for name in ("pipeline", "hw", "disco_twin"):
        (tmp_path / name).mkdir()
        for file in ("__init__.py", "__main__.py"):
            (tmp_path / name / file).write_text(f"raise SystemExit('the trap {name} was imported')")
    for name in ("types", "numpy", "logging"):
        (tmp_path / f"{name}.py").write_text(f"raise SystemExit('the trap {name} was imported')")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (code_command("import hw, pipeline, disco_twin, numpy; print(hw.__path__)"), str(Path(hw.__path__[0]))),
        (module_command("hw.safety.supervisor"), "IndexError"),  # it wants arguments
    ],
)
def test_children_import_nothing_from_the_current_folder(traps: Path, command: list[str], says: str) -> None:
    done = subprocess.run(command, env=child_environment(), capture_output=True, text=True, check=False)
    assert says in done.stdout + done.stderr and "trap" not in done.stdout + done.stderr


def test_every_child_is_started_that_way() -> None:
    """`sys.executable` stands in one module: other ways to start Python look in the current folder."""
    root = Path(ROOT)
    own = {str(p.relative_to(root)) for room in ("hw", "pipeline", "disco_twin") for p in (root / room).rglob("*.py")}
    assert {p for p in own if "sys.executable" in (root / p).read_text()} == {"hw/base/children.py"}


def test_as_a_module_it_is_the_command(tmp_path: Path) -> None:
    """In a folder that has a `pipeline` and a `hw` of another kind, too."""
    for name in ("pipeline", "hw"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise SystemExit('a trap')")
    command = [sys.executable, "-m", "disco_twin", "--help"]
    done = subprocess.run(
        command, cwd=tmp_path, env=child_environment() | {"PYTHONSAFEPATH": ""}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0 and "Usage: disco-twin" in done.stdout, done.stderr


@pytest.fixture
def arguments(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """The program's own arguments may be set; handlers of signals are put back."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)}
    yield monkeypatch
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252"])
def test_terminals_that_lack_a_character_show_its_number(arguments: pytest.MonkeyPatch, encoding: str) -> None:
    shown = io.BytesIO()
    arguments.setattr(sys, "stderr", io.TextIOWrapper(shown, encoding, write_through=True))
    arguments.setattr(sys, "argv", ["disco-twin", "plan", "\u4e2d.toml"])
    with pytest.raises(SystemExit) as end:
        start.main()
    assert end.value.code == 2
    assert re.fullmatch(r"disco-twin: \\u4e2d\.toml: no such file.*\n", shown.getvalue().decode(encoding))


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252", "utf-8"])
def test_the_progress_bar_on_any_terminal(encoding: str) -> None:
    shown = io.BytesIO()
    console = Console(file=io.TextIOWrapper(shown, encoding, write_through=True), force_terminal=True, width=80)
    with stage_bar(console, "capture", "images") as report:
        report(1, 2)
    assert b"capture" in shown.getvalue()


def test_a_current_folder_that_is_gone(arguments: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def gone() -> str:
        raise FileNotFoundError(2, "No such file or directory")

    arguments.setattr(start.os, "getcwd", gone)
    with pytest.raises(SystemExit) as end:
        start.main()
    assert end.value.code == 2
    assert capsys.readouterr().err == "disco-twin: the current folder is gone. Remedy: change into one that exists\n"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGINT])
def test_whatever_ends_the_program_says_so(
    arguments: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], number: signal.Signals
) -> None:
    arguments.setattr(app, "main", lambda: signal.raise_signal(number))
    with pytest.raises(SystemExit) as end:
        start.main()
    assert end.value.code == 130
    assert capsys.readouterr().err == "disco-twin: stopped; the same command continues\n"


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (["run", "", "--out", "x"], "SCENE"),
        (["run", "s.toml", "--out", ""], "--out"),
        (["capture", "s.toml", "--out", " "], "--out"),
        (["capture", "s.toml", "--out", "x", "--rig", ""], "--rig"),
        (["reference", "s.toml", "--out", ""], "--out"),
        (["reconstruct", "--out", ""], "--out"),
        (["score", "--out", ""], "--out"),
        (["import", "", "--out", "x"], "FOLDER"),
        (["import", "x", "--out", ""], "--out"),
        (["mesh", "x.ply", ""], "OUT"),
        (["quality", ""], "CAPTURE"),
        (["budget", ""], "OUT"),
        (["rig", "probe", ""], "RIG.TOML"),
        (["rig", "emulate", "s.toml", "--ports", ""], "--ports"),
    ],
)
def test_an_empty_name_is_not_the_current_folder(
    words: list[str], key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        app.main(words)
    assert end.value.code == 2 and not list(tmp_path.iterdir())
    assert capsys.readouterr().err.startswith(f"disco-twin: {key}: is empty. Remedy: ")
