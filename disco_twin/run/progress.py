"""What a user sees while a run works: a line per finished stage, and a bar with speed and time left."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

Report = Callable[[int, int], None]  # done, total


class SpeedColumn(ProgressColumn):
    """Images a second, or whatever is counted."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self.unit = unit

    def render(self, task: Task) -> Text:
        """Speed of the steps that were done now (not of those found from before)."""
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.3g} {self.unit}/s", style="dim")


class WholeColumn(ProgressColumn):
    """How much longer the whole run takes. whole: from the seconds that are left of this stage, None if not known."""

    def __init__(self, whole: Callable[[float | None], str]) -> None:
        super().__init__()
        self.whole = whole

    def render(self, task: Task) -> Text:
        """As the stage's own speed has it, too."""
        return Text(self.whole(task.time_remaining), style="dim")


@contextmanager
def stage_bar(
    console: Console, name: str, unit: str, whole: Callable[[float | None], str] | None = None
) -> Iterator[Report]:
    """A progress bar for a stage; gone when the stage has ended. Nothing where there is no terminal to draw it on.

    whole: what the bar says of the whole run, from the seconds that are left of this stage
    """
    if not console.is_terminal:
        yield lambda done, total: None
        return
    plain = not console.encoding.lower().startswith("utf")
    columns: tuple[ProgressColumn, ...] = (
        SpinnerColumn("line" if plain else "dots"),
        TextColumn("{task.description:<12}"),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        SpeedColumn(unit),
        TimeElapsedColumn(),
        TextColumn("left", style="dim"),
        TimeRemainingColumn(),
        *(() if whole is None else (WholeColumn(whole),)),
    )
    with Progress(*columns, console=console, transient=True, redirect_stdout=False, redirect_stderr=False) as progress:
        task = progress.add_task(name, total=None)

        def report(done: int, total: int) -> None:
            started = progress.tasks[0].total is not None
            progress.update(task, total=total)
            if not started and done > 1:  # resumed: what was there before does not count towards the speed
                progress.reset(task, total=total, completed=done)
            else:
                progress.update(task, completed=done)

        yield report


@contextmanager
def run_log(path: Path, console: Console) -> Iterator[None]:
    """Our own log messages of a run go to a file, with times; warnings go to the screen, too, a line each."""
    file = _LogFile(path, console)
    try:
        with screen_log(console), _handling(file):
            yield
    finally:
        file.close()


@contextmanager
def screen_log(console: Console) -> Iterator[None]:
    """Our own warnings go to the screen, a line each."""
    with _handling(_Screen(console)):
        yield


@contextmanager
def _handling(handler: logging.Handler) -> Iterator[None]:
    loggers = [logging.getLogger(name) for name in ("disco_twin", "pipeline", "hw")]
    for logger in loggers:
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeHandler(handler)


class _Screen(logging.Handler):
    """Warnings on the screen, above the progress bar."""

    def __init__(self, console: Console) -> None:
        super().__init__(logging.WARNING)
        self.console = console

    def emit(self, record: logging.LogRecord) -> None:
        text = f"  warning: {record.getMessage()}"
        self.console.print(text, style="yellow", highlight=False, markup=False, soft_wrap=True)


class _LogFile(logging.FileHandler):
    """run.log. A disk that takes no more of it is reported once, on the screen, and does not end the run."""

    def __init__(self, path: Path, console: Console) -> None:
        super().__init__(path, encoding="utf-8", errors="backslashreplace")
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        self.console, self.refused = console, False

    def handleError(self, record: logging.LogRecord) -> None:
        if not self.refused:
            self.console.print(f"  warning: {self.baseFilename} takes no more messages", style="yellow", markup=False)
        self.refused = True
