"""The page on writing a driver: its blocks are one module, whose tests pass."""

from __future__ import annotations

import re
from pathlib import Path


def test_the_page_s_own_tests_pass(repository: Path) -> None:
    text = (repository / "docs" / "howto" / "write-a-driver.md").read_text(encoding="utf-8")
    module: dict[str, object] = {"__name__": "howto"}
    exec("\n".join(re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)), module)
    tests = [test for name, test in module.items() if name.startswith("test_")]
    assert len(tests) == 2
    for test in tests:
        test()  # type: ignore[operator]
