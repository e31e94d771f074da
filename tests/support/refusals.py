"""How a command that is refused is heard."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from disco_twin.cli.app import main

Says = Callable[..., str]


@pytest.fixture
def says(capsys: pytest.CaptureFixture[str]) -> Says:
    """The one line on stderr of a command that is refused, less its `disco-twin: `."""

    def refused(*words: object) -> str:
        with pytest.raises(SystemExit) as end:
            main([str(word) for word in words])
        said = capsys.readouterr().err
        assert end.value.code == 2 and said.count("\n") == 1 and len(said) < 700, said
        assert said.startswith("disco-twin: ") and ". Remedy: " in said, said
        return said.removeprefix("disco-twin: ").rstrip("\n")

    return refused
