"""`python -m benchmarks.accuracy_table RECORD.json PAGE.md`: the benchmark's figures as the page's tables.

They stand between the lines `<!-- figures -->` and `<!-- end of figures -->`, from which all is replaced.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

BEGIN, END = "<!-- figures -->\n", "<!-- end of figures -->\n"


def tables(record: Mapping[str, Any]) -> str:
    """nrmse by object, method and light; means; what is lost; seconds and memory."""
    lights = list(next(iter(next(iter(record["objects"].values())).values())))
    lost = {(row["object"], row["light"], row["baseline"]) for row in record["lost"]}
    rows = []
    for name, methods in [*record["objects"].items(), ("**mean of the set**", record["mean"])]:
        for i, (method, own) in enumerate(methods.items()):
            took = record["seconds"].get(name, {}).get(method)
            memory = record["memory"].get(name, {}).get(method)
            cells = [f"{figure(own[x])}{' *' if (name, x, method) in lost else ''}" for x in lights]
            rows.append(
                ["" if i else name, method, *cells, "" if took is None else f"{took:.0f}", figure(memory, ".0f")]
            )
    worst = sorted(record["lost"], key=lambda row: -row["difference"] / row["standard_error"])
    losses = [
        [row["object"], row["light"], row["baseline"], figure(row["difference"], ".4f"),
         figure(row["standard_error"], ".4f"), f"{row['difference'] / row['standard_error']:.0f}"]
        for row in worst
    ]  # fmt: skip
    parts = [
        f"Commit {record['commit']}, {record['cores']} cores, {record['wall_s'] / 60:.0f} minutes. A star: better than "
        "the default by more than three standard errors of the paired difference.",
        table(["object", "method", *lights, "s", "MiB"], rows),
        f"Lost, {len(losses)} of {len(record['paired'])} pairs (differences of nrmse^2):"
        if losses
        else "Nothing is lost.",
        table(["object", "light", "baseline", "difference", "standard error", "ratio"], losses) if losses else "",
    ]
    parts += [f"Failed: {row['object']} ({row['because']})." for row in record["failed"]]
    return "\n\n".join(part for part in parts if part) + "\n"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def figure(value: float | None, form: str = ".3f") -> str:
    """Three digits without the leading zero, or nothing."""
    if value is None:
        return "-" if form == ".3f" else ""
    return f"{value:{form}}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:{form}}"


def filled(page: str, record: Mapping[str, Any]) -> str:
    """The page with the record's tables. Raises: ValueError where it has no place for them."""
    before, _, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        raise ValueError(f"the page has no lines {BEGIN.strip()} and {END.strip()}")
    return before + BEGIN + "\n" + tables(record) + "\n" + END + after


if __name__ == "__main__":
    target = Path(sys.argv[2])
    target.write_text(filled(target.read_text(), json.loads(Path(sys.argv[1]).read_text())))
