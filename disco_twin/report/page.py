"""report.html: one self-contained page that shows what a run did and how well; no network, no scripts."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from disco_twin.report import calibration as report_calibration
from disco_twin.report import figures
from hw.base.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

F64 = NDArray[np.float64]
Summary = Mapping[str, Any]

BROAD = ("uniform", "directional", "environment")

STYLE = """
:root { color-scheme: light; --ink: #22272e; --soft: #5b626c; --line: #e3e6ea; --accent: #1f6391; }
* { box-sizing: border-box; }
body { margin: 0; background: #fbfbfc; color: var(--ink);
  font: 15px/1.55 -apple-system, "Segoe UI", "Helvetica Neue", "DejaVu Sans", Arial, sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 40px 28px 80px; }
h1 { font-size: 27px; font-weight: 600; margin: 0; letter-spacing: -.01em; }
h2 { font-size: 18px; font-weight: 600; margin: 52px 0 4px; padding-top: 18px; border-top: 1px solid var(--line); }
h3 { font-size: 14px; font-weight: 600; margin: 26px 0 2px; }
p { margin: 6px 0 12px; max-width: 78ch; color: var(--soft); }
header p { font-size: 16px; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; margin: 26px 0 8px; }
.card { background: #fff; border: 1px solid var(--line); border-radius: 8px; padding: 12px 16px; }
.card b { display: block; font-size: 23px; font-weight: 600; letter-spacing: -.01em; }
.card span { color: var(--soft); font-size: 13px; }
figure { margin: 12px 0 6px; background: #fff; border: 1px solid var(--line); border-radius: 8px; padding: 12px; }
figure img { display: block; max-width: 100%; height: auto; margin: 0 auto; }
table { border-collapse: collapse; background: #fff; border: 1px solid var(--line); margin: 12px 0; width: 100%; }
th, td { padding: 5px 12px; text-align: right; border-bottom: 1px solid var(--line);
  font-variant-numeric: tabular-nums; font-size: 13.5px; }
th { color: var(--soft); font-weight: 500; }
th:first-child, td:first-child, td.text, th.text { text-align: left; }
td.best { color: var(--accent); font-weight: 600; }
details summary { cursor: pointer; color: var(--accent); margin: 8px 0; font-size: 14px; }
.note { background: #fff8ec; border: 1px solid #f0dfc0; border-radius: 8px; padding: 10px 16px; margin: 18px 0 0; }
"""


@dataclass(frozen=True)
class ReportData:
    """What the page shows beyond the summary; what is left empty is left out of the page.

    distance: (n, V) mm from the truth columns' vertices; truth: (L, n, V); models: the same by method, mm^-2
    decades: by method, the log10 rmse of "measured" and of all ("completed") entries and the "coverage" by decade
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
    seconds: Mapping[str, float] = field(default_factory=dict)
    balance: Mapping[str, Sequence[float]] = field(default_factory=dict)
    imbalance: float = 0.0
    notes: Sequence[str] = ()


def write_report(data: ReportData, path: Path) -> None:
    """Write the page."""
    write_atomically(path, render(data).encode())


def render(data: ReportData) -> str:
    """The page as HTML."""
    parts = (_impulses, _relit, _errors, _reflectance, _calibration, _costs, _left_out)
    sections = [part(data) for part in parts]
    name = html.escape(str(data.summary["scene"]))
    return (
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>disco-twin: {name}</title>"
        f"<meta name='viewport' content='width=device-width'><style>{STYLE}</style></head><body><main>"
        f"{_header(data)}{''.join(sections)}</main></body></html>\n"
    )


def _header(data: ReportData) -> str:
    summary = data.summary
    capture = summary["capture"]
    broad = [r for r in summary["relit"] if r["light"] in BROAD]
    cards = [
        (figure_or_dash(pooled(broad, data.main)), "nrmse under broad light"),
        (f"{capture['images']:,}", f"images of {capture['spots']} spots in {capture['views']} views"),
        (_bytes(capture["bytes_stored"]), f"stored, from {_bytes(capture['bytes_raw'])} raw"),
        (_duration(sum(s["seconds"] for s in summary["stages"])), "from scene to scores"),
        (f"{max((s['peak_mb'] for s in summary['stages']), default=0) / 1024:.1f} GiB", "peak memory"),
    ]
    tiles = "".join(f"<div class='card'><b>{html.escape(a)}</b><span>{html.escape(b)}</span></div>" for a, b in cards)
    notes = "".join(f"<div class='note'>{html.escape(n)}</div>" for n in data.notes)
    return (
        f"<header><h1>{html.escape(str(summary['scene']))}</h1><p>A laser sweep of a translucent object in the twin, "
        f"its reconstruction by the method <b>{html.escape(data.main)}</b>, and the relit images beside references "
        f"rendered in Mitsuba. Seed {summary['seed']}.</p><div class='cards'>{tiles}</div>{notes}</header>"
    )


def _impulses(data: ReportData) -> str:
    if not data.impulses:
        return ""
    return _section(
        "Impulse responses",
        "What the cameras recorded of single laser spots, as the pipeline reads it: radiance on a log scale, six "
        "decades. Columns are spots, rows are cameras.",
        _image(figures.impulse_figure(data.impulses), "impulse responses"),
    )


def _relit(data: ReportData) -> str:
    parts = []
    for light in dict.fromkeys(c.light for c in data.comparisons):
        rows = [c for c in data.comparisons if c.light == light]
        parts.append(f"<h3>{html.escape(light)}</h3>" + _image(figures.comparison_figure(rows, [data.main]), light))
    if not parts:
        return ""
    return _section(
        "Relit images",
        "Relit from the captured model, the reference under the same light (light that came from below the surface, "
        "seen from a held-out view), and their difference as a share of the reference's 99th percentile, averaged "
        "over wavelengths. Images share the reference's exposure; gamma 2.2.",
        "".join(parts),
    )


def _errors(data: ReportData) -> str:
    relit = data.summary["relit"]
    methods = list(dict.fromkeys(str(r["method"]) for r in relit))
    if not methods:
        return ""
    errors = {m: pooled(relit, m) for m in methods}
    points = {m: (data.seconds[m], e) for m, e in errors.items() if m in data.seconds and e > 0}
    pareto = _image(figures.pareto_figure(points), "error against time") if points else ""
    rows = []
    for light in dict.fromkeys(str(r["light"]) for r in relit):
        values = [pooled(relit, m, light) for m in methods]
        best = min((v for v in values if np.isfinite(v)), default=None)
        cells = "".join(f"<td{' class=best' if v == best else ''}>{figure_or_dash(v)}</td>" for v in values)
        own = [r for r in relit if r["light"] == light and r["method"] == data.main]
        energy = " / ".join(figure_or_dash(r["energy_ratio"]) for r in own)
        floor = rms([r["nrmse_floor"] for r in own if r["nrmse_floor"] is not None])
        rows.append(f"<tr><td>{html.escape(light)}</td>{cells}<td>{energy}</td><td>{figure_or_dash(floor)}</td></tr>")
    heads = "".join(f"<th>{html.escape(m)}</th>" for m in methods)
    table = (
        f"<table><tr><th>light</th>{heads}<th>energy ratio, {html.escape(data.main)}</th><th>noise removed</th></tr>"
        + "".join(rows)
        + "</table>"
    )
    keys = ["light", "view", "method", "nrmse", "nrmse_se", "nrmse_floor", "psnr", "energy_ratio"]
    full = "".join("<tr>" + "".join(f"<td>{_cell(r.get(k))}</td>" for k in keys) + "</tr>" for r in relit)
    details = (
        "<details><summary>Every score</summary><table><tr>"
        + "".join(f"<th>{k}</th>" for k in keys)
        + f"</tr>{full}</table></details>"
    )
    return _section(
        "Errors",
        "nrmse over object pixels in linear radiance, pooled over the held-out views (rms); the reference's own noise "
        "is removed without bias. Lambertian surface and homogeneous dipole are fitted to the same capture.",
        table + _image(figures.light_error_figure(relit, methods), "error per light") + pareto + details,
    )


def _reflectance(data: ReportData) -> str:
    parts = []
    if data.truth is not None and data.distance is not None:
        drawn = figures.reflectance_figure(data.distance, data.truth, data.models, data.wavelengths_nm)
        parts.append(_image(drawn, "R_d against distance"))
    if data.main in data.decades:
        bars = {f"{data.main}, measured": data.decades[data.main]["measured"]}
        bars |= {method: scores["completed"] for method, scores in data.decades.items()}
        drawn = figures.decade_figure(bars, data.decades[data.main]["coverage"])
        parts.append(_image(drawn, "error per decade"))
    if not parts:
        return ""
    return _section(
        "Diffuse subsurface reflectance",
        "R_d between pairs of vertices against the truth that the twin computed with photons of its own: median, and "
        "the band from the 10th to the 90th percentile. Below: the error per decade below the peak, of the entries "
        "that were measured and of all entries once the model was completed, and the share that was measured.",
        "".join(parts),
    )


def _calibration(data: ReportData) -> str:
    text, body = report_calibration.section(data.summary["calibration"], data.wavelengths_nm)
    return _section("Calibration", text, body)


def _costs(data: ReportData) -> str:
    parts = [_image(figures.stage_figure(data.summary["stages"]), "time and memory per stage")]
    if data.balance:
        parts.append("<h3>Energy balance of the ground truth</h3>")
        parts.append(
            "<p>Launched over the truth's columns and where it went; <i>boundary</i> is the rough boundary's own loss "
            f"(it scatters once only). The terms add up to one within {data.imbalance:.1e}.</p>"
        )
        parts.append(_image(figures.balance_figure(data.balance, data.wavelengths_nm), "energy balance"))
    text = "Every stage with its own wall-clock time and peak memory."
    return _section("Time, memory and energy", text, "".join(parts))


def _left_out(data: ReportData) -> str:
    items = data.summary["left_out"]
    if not items:
        return _section("What was left out", "Nothing: this scene needs every step.", "")
    rows = "".join(
        f"<tr><td>{html.escape(i['what'])}</td><td class='text'>{html.escape(i['because'])}</td></tr>" for i in items
    )
    table = f"<table><tr><th>what</th><th class='text'>because</th></tr>{rows}</table>"
    return _section("What was left out", "Steps that this scene does not need, each with its reason.", table)


def _section(title: str, text: str, body: str) -> str:
    return f"<section><h2>{html.escape(title)}</h2><p>{html.escape(text)}</p>{body}</section>"


def _image(figure: Figure, alt: str) -> str:
    """An embedded PNG at twice the page's resolution."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=170, metadata={"Software": None})
    width = round(float(figure.get_figwidth()) * 100)
    data = base64.b64encode(buffer.getvalue()).decode()
    return f"<figure><img width='{width}' alt='{html.escape(alt)}' src='data:image/png;base64,{data}'></figure>"


def rms(values: Sequence[float]) -> float:
    """Root mean square that keeps the sign of each value's square (nrmse may be negative within its noise)."""
    square = float(np.mean([v * abs(v) for v in values])) if values else float("nan")
    return float(np.copysign(abs(square) ** 0.5, square))


def pooled(relit: Sequence[Mapping[str, Any]], method: str, light: str | None = None) -> float:
    """rms of a method's nrmse over the views, and over the lights unless one is given; NaN where there is no score."""
    rows = [r for r in relit if r["method"] == method and light in (None, r["light"])]
    return rms([float(r["nrmse"]) for r in rows if r["nrmse"] is not None])


def figure_or_dash(value: float | None) -> str:
    """Three digits, or a dash where there is no score."""
    return "-" if value is None or not np.isfinite(value) else f"{value:.3f}"


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else html.escape(str(value))


def _bytes(count: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
