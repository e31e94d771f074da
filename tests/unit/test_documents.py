"""What the documents name exists, and a decision can be read at one sitting."""

from __future__ import annotations

import re
from pathlib import Path

from pipeline.run import Request

FLOORS = r"(?:hw|pipeline|disco_twin|tests|benchmarks|scenes|docs)"
SCREEN = 60  # lines


def documents(repository: Path) -> list[Path]:
    """README and all pages but the decisions' diaries, which keep the names of their time."""
    return [repository / "README.md", *(p for p in (repository / "docs").rglob("*.md") if p.parent.name != "diary")]


def test_links_lead_somewhere(repository: Path) -> None:
    links = [
        (page, link)
        for page in [*documents(repository), *(repository / "docs").rglob("diary/*.md")]
        for link in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text())
        if not link.startswith("http")
    ]
    assert len(links) > 10
    assert [(page.name, link) for page, link in links if not (page.parent / link).exists()] == []


def test_paths_and_modules_exist(repository: Path) -> None:
    """`pipeline/run.py` is a file, `pipeline.run.relight` a name in one."""
    gone = []
    for page in documents(repository):
        text = page.read_text()
        gone += [(page.name, p) for p in re.findall(rf"`({FLOORS}/[\w/.-]+)`", text) if not (repository / p).exists()]
        for name in re.findall(r"\b((?:hw|pipeline|disco_twin)(?:\.\w+)+)", text):
            *rooms, last = name.split(".")
            module = repository.joinpath(*rooms)
            files = [module.with_suffix(".py"), module / "__init__.py"]
            inside = any(f.is_file() and re.search(rf"\b{last}\b", f.read_text()) for f in files)
            if not (inside or (module / last).is_dir() or (module / f"{last}.py").is_file()):
                gone.append((page.name, name))
    assert gone == []


def test_a_decision_fits_a_screen(repository: Path) -> None:
    """What is longer has a diary: `docs/decisions/diary/`, behind a link."""
    pages = {page.name: page.read_text() for page in (repository / "docs" / "decisions").glob("*.md")}
    assert {name: n for name, text in pages.items() if (n := len(text.splitlines())) > SCREEN} == {}
    numbers = [name[:4] for name in pages]
    assert sorted(set(numbers)) == sorted(numbers)
    assert [name for name, text in pages.items() if not text.startswith(f"# {name[:4]} ")] == []
    for diary in (repository / "docs" / "decisions" / "diary").glob("*.md"):
        assert f"](diary/{diary.name})" in pages[diary.name]


def test_the_request_that_is_shown_can_be_read(repository: Path) -> None:
    """The remedy for a request that cannot be read names this page."""
    (shown,) = re.findall(r"`({\"format_version\".*?})`", (repository / "docs" / "conventions.md").read_text(), re.S)
    assert Request.model_validate_json(shown).relight.lights[0].name == "sky"
