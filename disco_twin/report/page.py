"""report.html: one self-contained page that shows what a run did and how well; no network, no scripts."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

from disco_twin.evaluate.summary import figure_or_dash, pooled, rms
from disco_twin.report import figures
from hw.base.arrays import F64
from hw.base.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Summary = Mapping[str, Any]

DPI = 170
CONTENTS = "[contents]"  # where the links to the sections go, once it is known which there are
BROAD = ("uniform", "directional", "environment")


@dataclass(frozen=True)
class ReportData:
    """What the page shows beyond the summary; what is left empty is left out of the page.

    distance: (n, V) mm from the truth columns' vertices; truth: (L, n, V) exitance per irradiance; models: the same by
        method, mm^-2
    decades: by method, the log10 rmse of "measured" and of all ("completed") entries and the "coverage" by decade
    totals: by method, of `lit` and `unlit` columns, the fields of `evaluate.totals.TotalsScore`
    seconds: reconstruction and relighting of each method; balance: term -> share of the launched power per wavelength
    imbalance: largest departure of their sum from one, roulette included
    """

    summary: Summary
    wavelengths_nm: Sequence[float]
    main: str
    impulses: Sequence[Sequence[figures.Impulse]] = ()
    comparisons: Sequence[figures.Comparison] = ()
    distance: F64 | None = None
    truth: F64 | None = None
    models: Mapping[str, F64] = field(default_factory=dict)
    decades: Mapping[str, Mapping[str, Mapping[str, float | None]]] = field(default_factory=dict)
    totals: Mapping[str, Mapping[str, Mapping[str, Any]]] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    balance: Mapping[str, Sequence[float]] = field(default_factory=dict)
    imbalance: float = 0.0
    notes: Sequence[str] = ()


def write_report(data: ReportData, path: Path) -> None:
    """Write the page."""
    write_atomically(path, render(data).encode())


def render(data: ReportData) -> str:
    """The page as HTML: `templates/report.html.j2`, with the figures embedded."""
    loader = PackageLoader("disco_twin.report")
    page = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    page.filters |= {
        "width": page_width,
        "picture": picture,
        "anchor": anchor,
        "three_digits": figure_or_dash,
        "duration": duration,
        "with_error": with_error,
    }
    relit = data.summary["relit"]
    methods = list(dict.fromkeys(str(row["method"]) for row in relit))
    errors = {method: pooled(relit, method) for method in methods}
    whole = page.get_template("report.html.j2").render(
        contents=CONTENTS,
        data=data,
        summary=data.summary,
        figures=figures,
        methods=methods,
        outside=any("volpath_nrmse" in row for row in relit),
        broad=pooled([row for row in relit if row["light"] in BROAD], data.main),
        light_rows=[light_row(relit, light, methods, data.main) for light in dict.fromkeys(r["light"] for r in relit)],
        pareto={m: (data.seconds[m], e) for m, e in errors.items() if m in data.seconds and e > 0},
        decades=decade_bars(data),
        z_rows=z_rows(data.summary.get("z") or {}),
    )
    links = (f'<a href="#{name}">{title}</a>' for name, title in re.findall(r'<h2 id="([^"]+)">(.*?)</h2>', whole))
    return whole.replace(CONTENTS, " ".join(links))


def anchor(title: str) -> str:
    """A heading's name in links."""
    return re.sub(r"[^a-z]+", "-", title.lower()).strip("-")


def light_row(relit: Sequence[Summary], light: str, methods: Sequence[str], main: str) -> dict[str, Any]:
    """A light's row in the table of errors: every method's nrmse; energy ratios, rim and noise of the main one."""
    errors = [pooled(relit, method, light) for method in methods]
    own = [row for row in relit if (row["light"], row["method"]) == (light, main)]
    return {
        "light": light,
        "errors": errors,
        "best": min((e for e in errors if np.isfinite(e)), default=None),
        "rim": pooled(relit, main, light, "rim_nrmse"),
        "outside": pooled(relit, main, light, "volpath_nrmse"),
        "energy": [row["energy_ratio"] for row in own],
        "noise": rms([row["nrmse_floor"] for row in own if row["nrmse_floor"] is not None]),
    }


def z_rows(z: Mapping[str, Any]) -> list[tuple[str, str, Summary]]:
    """(what, how errors are taken, count and rms and share beyond 3) of all z-scores that there are."""
    rows = [(f"entries, decade {decade}", "", own) for decade, own in z.get("entries", {}).items()]
    rows += [("slopes of the angular term", "", z["slopes"])] if "slopes" in z else []
    for part, what in (("totals", "totals of {} columns"), ("pixels", "pixels under {}")):
        for name, errors in z.get(part, {}).items():
            rows += [(what.format(name), kind, own) for kind, own in errors.items()]
    return [row for row in rows if row[2]["count"]]


def decade_bars(data: ReportData) -> dict[str, Mapping[str, float | None]]:
    """Errors of R_d by decade: of the main method's measured entries, and of all entries of every method."""
    if data.main not in data.decades:
        return {}
    bars = {f"{data.main}, measured": data.decades[data.main]["measured"]}
    return bars | {method: scores["completed"] for method, scores in data.decades.items()}


def with_error(figures: Mapping[str, Any], name: str) -> str:
    """A figure of each wavelength and its standard error, `<name>_se`."""
    pairs = zip(figures[name], figures[f"{name}_se"], strict=True)
    return ", ".join(figure_or_dash(value) + ("" if error is None else f" ± {error:.3f}") for value, error in pairs)


def page_width(figure: Figure) -> int:
    """A figure's width on the page, in CSS pixels."""
    return round(float(figure.get_figwidth()) * 100)


def picture(figure: Figure, photograph: bool = False) -> str:
    """A figure as a data URI, of nearly twice the page's resolution. photograph: of images, whose shades no palette
    holds; they are compressed as such.
    """
    buffer, shown = io.BytesIO(), io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    image = Image.open(buffer).convert("RGB")
    if photograph:
        image.save(shown, "WEBP", quality=82, method=4)
    else:
        image.quantize(64, dither=Image.Dither.NONE).save(shown, "PNG", optimize=True)
    kind = "webp" if photograph else "png"
    return f"data:image/{kind};base64,{base64.b64encode(shown.getvalue()).decode()}"


def duration(seconds: float) -> str:
    """Seconds, minutes or hours, whichever reads well."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
