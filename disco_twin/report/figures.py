"""The report's figures, each a function from plain arrays to a matplotlib figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hw.base.arrays import F32, F64, Bool
from pipeline.reconstruct.registry import known_methods

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


STYLE = Path(__file__).with_name("templates") / "figures.mplstyle"

INK, FAINT, TRUTH = "#22272e", "#c9cdd3", "#22272e"
SPARE = ("#cc79a7", "#d55e00", "#56b4e9", "#6b5b00")
MARKERS, DASHES = "oDs^vP", ("-", (0, (5, 1.5)), (0, (1.5, 1)), (0, (6, 1.5, 1.5, 1.5)))  # beside colour: for print
DIFFERENCE_SPAN = 0.2  # the difference's colour scale runs to +- this share of the reference's 99th percentile


def colour(method: str) -> str:
    """A method's colour is the same in every figure."""
    known = known_methods().get(method)
    return (known and known.colour) or SPARE[sum(map(ord, method)) % len(SPARE)]


def marker(place: int) -> str:
    """Of the method in this place of a legend."""
    return MARKERS[place % len(MARKERS)]


def new_figure(width: float, height: float, **subplots: Any) -> tuple[Figure, Any]:
    """A figure that belongs to no window, and its axes, in the report's style. Sizes in inches."""
    import matplotlib.style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    matplotlib.style.use(STYLE)
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(**subplots)


def plain(axes: Axes) -> None:
    """An image's frame: none."""
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def scale_bar(axes: Axes, mm_per_pixel: float, height: int, ink: str = "white") -> None:
    """A bar of a round length in mm, about a sixth of the image wide, at the lower left. (height in pixels)"""
    wanted = 32 * mm_per_pixel * height / 124
    length = min((1, 2, 5, 10, 20, 50, 100), key=lambda mm: abs(np.log(mm / wanted)))
    x, y = 0.05 * height, 0.94 * height
    axes.plot([x, x + length / mm_per_pixel], [y, y], color=ink, lw=2, solid_capstyle="butt")
    axes.text(x, y - 0.03 * height, f"{length} mm", color=ink, fontsize=7, va="bottom")


def tone(image: F32, exposure: float, lasers: int) -> F64:
    """(L, H, W) radiance -> (H, W, 3) display values: 99th percentile to one, gamma 2.2; one laser: grey."""
    rgb = image if lasers == 3 else np.repeat(image[:1], 3, axis=0)
    return np.asarray(np.clip(rgb / exposure, 0, 1).transpose(1, 2, 0) ** (1 / 2.2), dtype=np.float64)


@dataclass(frozen=True)
class Comparison:
    """Relit images against the reference for one light and view; images (L, H, W) in W/(mm^2 sr), mask (H, W)."""

    light: str
    view: str
    reference: F32
    relit: Mapping[str, F32]
    mask: Bool
    mm_per_pixel: float
    nrmse: Mapping[str, float]


def comparison_figure(rows: Sequence[Comparison], shown: Sequence[str]) -> Figure:
    """One light: for each view the relit images, the reference and the differences, with scale bars and the radiance
    that is white; as far as there is an object.
    """
    columns = len(shown) * 2 + 1
    figure, axes = new_figure(3.3 * columns, 2.2 * len(rows), nrows=len(rows), ncols=columns, squeeze=False)
    for line, whole in zip(axes, rows, strict=True):
        row = cropped(whole)
        lasers, height, _ = row.reference.shape
        exposure = float(np.percentile(row.reference[:, row.mask], 99)) if row.mask.any() else 1.0
        exposure = exposure if exposure > 0 else 1.0
        pictures = [(m, row.relit[m]) for m in shown] + [("reference", row.reference)]
        for axis, (name, image) in zip(line, pictures, strict=False):
            axis.imshow(tone(image, exposure, lasers), interpolation="nearest")
            note = f", nrmse {row.nrmse[name]:.3f}" if name in row.nrmse else ""
            axis.set_title(f"{row.view}: {name}{note}", loc="left", fontsize=8)
            scale_bar(axis, row.mm_per_pixel, height)
        line[len(pictures) - 1].set_title(
            f"{row.view}: reference, white {exposure:.2g} W/(mm² sr)", loc="left", fontsize=8
        )
        for axis, name in zip(line[len(pictures) :], shown, strict=True):
            difference = np.where(row.mask, (row.relit[name] - row.reference).mean(axis=0) / exposure, np.nan)
            drawn = axis.imshow(difference, cmap="RdBu_r", vmin=-DIFFERENCE_SPAN, vmax=DIFFERENCE_SPAN)
            axis.set_title(f"{row.view}: {name} minus reference", loc="left", fontsize=8)
        for axis in line:
            plain(axis)
        bar = figure.colorbar(drawn, ax=line, fraction=0.02, pad=0.01, shrink=0.85)
        bar.set_ticks([-DIFFERENCE_SPAN, 0, DIFFERENCE_SPAN], labels=["-20 %", "0", "+20 %"])
        bar.ax.tick_params(labelsize=7)
        bar.outline.set_visible(False)
    return figure


def cropped(row: Comparison, margin: int = 4) -> Comparison:
    """The part that shows the object, with some pixels around it; all of it where nothing does."""
    y, x = np.nonzero(row.mask)
    if not len(y):
        return row
    window = (
        slice(max(0, y.min() - margin), y.max() + margin + 1),
        slice(max(0, x.min() - margin), x.max() + margin + 1),
    )
    relit = {name: image[:, *window] for name, image in row.relit.items()}
    return replace(row, reference=row.reference[:, *window], relit=relit, mask=row.mask[window])


@dataclass(frozen=True)
class Impulse:
    """What a camera saw of one spot: radiance (H, W) in W/(mm^2 sr) per watt."""

    camera: str
    spot: int
    radiance: F32
    mm_per_pixel: float


def impulse_figure(impulses: Sequence[Sequence[Impulse]]) -> Figure:
    """Impulse responses on a log scale: a row per camera, a column per spot, six decades below the peak."""
    from matplotlib.colors import LogNorm

    rows, columns = len(impulses), len(impulses[0])
    figure, axes = new_figure(2.5 * columns + 0.6, 1.68 * rows + 0.25, nrows=rows, ncols=columns, squeeze=False)
    peak = max(float(i.radiance.max()) for row in impulses for i in row)
    floor = peak * 1e-6
    norm = LogNorm(floor, peak)
    for line, row in zip(axes, impulses, strict=True):
        for axis, impulse in zip(line, row, strict=True):
            drawn = axis.imshow(np.maximum(impulse.radiance, floor), norm=norm, cmap="magma")
            axis.set_title(f"spot {impulse.spot}, {impulse.camera}", loc="left", fontsize=8)
            plain(axis)
            scale_bar(axis, impulse.mm_per_pixel, impulse.radiance.shape[0])
    bar = figure.colorbar(drawn, ax=axes, fraction=0.02, pad=0.01)
    bar.set_label("radiance per watt, 1/(mm² sr)")
    bar.outline.set_visible(False)
    return figure


def label_log_axis(axis: Any) -> None:
    """Plain numbers at 1, 2 and 5 of every decade."""
    axis.set_major_formatter(lambda v, _: f"{v:g}")
    axis.set_minor_formatter(lambda v, _: f"{v:g}" if f"{v:.0e}"[0] in "25" else "")


def light_error_figure(relit: Sequence[Mapping[str, Any]], methods: Sequence[str]) -> Figure:
    """nrmse of every method for every light, both views; log scale."""
    lights = list(dict.fromkeys(str(r["light"]) for r in relit))
    figure, axis = new_figure(7.2, 0.36 * len(lights) + 1.0)
    for place, (offset, method) in enumerate(
        zip(np.linspace(-0.24, 0.24, max(len(methods), 2)), methods, strict=False)
    ):
        rows = [r for r in relit if r["method"] == method and r["nrmse"] is not None]
        x = np.array([max(float(r["nrmse"]), 1e-3) for r in rows])
        y = np.array([lights.index(r["light"]) for r in rows]) + offset
        error = np.array([float(r["nrmse_se"]) for r in rows])
        low = np.minimum(error, 0.95 * x)
        axis.errorbar(x, y, xerr=low, fmt=marker(place), ms=5, color=colour(method), lw=1, label=method)
    axis.set_xscale("log")
    label_log_axis(axis.xaxis)
    axis.set_yticks(range(len(lights)), lights)
    axis.set_ylim(len(lights) - 0.5, -0.5)
    axis.set_xlabel("nrmse against the reference (a point per held-out view, bars: one standard error)")
    axis.grid(False, axis="y")
    figure.legend(loc="outside upper left", ncols=len(methods))
    return figure


def pareto_figure(points: Mapping[str, tuple[float, float]]) -> Figure:
    """Error against time: per method (seconds, rms of nrmse over lights and views)."""
    figure, axis = new_figure(5.0, 3.0)
    for place, (method, (seconds, error)) in enumerate(points.items()):
        axis.plot(max(seconds, 1e-2), error, marker(place), ms=9, color=colour(method), label=method)
    axis.set_xscale("log")
    axis.set_yscale("log")
    for side in (axis.xaxis, axis.yaxis):
        label_log_axis(side)
    axis.margins(x=0.25, y=0.2)
    axis.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))  # labels at the points met each other
    axis.set_xlabel("reconstruction and relighting, s")
    axis.set_ylabel("nrmse, all lights and views (rms)")
    return figure


def reflectance_figure(
    distance: F64, truth: F64, models: Mapping[str, F64], wavelengths_nm: Sequence[float], bins: int = 22
) -> Figure:
    """Exitance per irradiance against distance: median and 10-90 % band, truth and models.

    distance: (n, V) mm; truth, models: (L, n, V) mm^-2
    """
    lasers = truth.shape[0]
    figure, axes = new_figure(3.4 * lasers + 0.4, 3.1, ncols=lasers, sharey=True, squeeze=False)
    edges = np.linspace(0, float(distance.max()) * 1.0001, bins + 1)
    which = np.digitize(distance.ravel(), edges) - 1
    centres = (edges[:-1] + edges[1:]) / 2
    peak = float(truth.max())
    for laser, axis in enumerate(axes[0]):
        for place, (name, values) in enumerate({"truth": truth, **models}.items()):
            stats = np.full((3, bins), np.nan)
            for b in range(bins):
                inside = values[laser].ravel()[which == b]
                inside = inside[np.isfinite(inside)]
                if inside.size >= 5:
                    stats[:, b] = np.percentile(inside, [10, 50, 90])
            ink = TRUTH if name == "truth" else colour(name)
            dash = DASHES[place % len(DASHES)]
            axis.plot(centres, stats[1], color=ink, lw=1.8 if name == "truth" else 1.4, ls=dash, label=name)
            if name in ("truth", next(iter(models), "")):
                axis.fill_between(centres, np.maximum(stats[0], peak * 1e-9), stats[2], color=ink, alpha=0.12, lw=0)
        axis.set_yscale("log")
        axis.set_ylim(peak * 1e-6, peak * 2)
        axis.set_title(f"{wavelengths_nm[laser]:g} nm", loc="left")
        axis.set_xlabel("distance between the vertices, mm")
    axes[0][0].set_ylabel("exitance per irradiance, mm$^{-2}$")
    axes[0][-1].legend()
    return figure


def decade_figure(rmse: Mapping[str, Mapping[str, float | None]], coverage: Mapping[str, float | None]) -> Figure:
    """log10 rmse of R_d per decade below the peak for each method, and the share of entries that were measured.

    A name "method, measured" is drawn in a lighter shade of the method's colour.
    """
    decades = sorted(coverage, key=float, reverse=True)
    figure, (left, right) = new_figure(9.0, 2.9, ncols=2, width_ratios=[3, 2])
    width = 0.8 / max(len(rmse), 1)
    x = np.arange(len(decades))
    for n, (method, values) in enumerate(rmse.items()):
        heights = [np.nan if (v := values.get(d)) is None else max(v, 0.0) for d in decades]
        ink, shade = colour(method.split(",")[0]), 0.5 if "," in method else 1.0
        at = x + (n - (len(rmse) - 1) / 2) * width
        hatch = "///" if "," in method else None
        left.bar(at, heights, width * 0.92, color=ink, alpha=shade, hatch=hatch, ec="w", lw=0, label=method)
    left.set_ylabel("log10 rmse of $R_d$")
    left.legend(ncols=2)
    left.margins(y=0.25)
    right.bar(x, [100 * (coverage[d] or 0.0) for d in decades], 0.6, color=FAINT)
    right.set_ylabel("measured entries, %")
    right.set_ylim(0, 100)
    for axis in (left, right):
        axis.set_xticks(x, decades)
        axis.grid(False, axis="x")
        axis.set_xlabel("decade below the peak")
    return figure


def stage_figure(stages: Sequence[Mapping[str, Any]]) -> Figure:
    """Seconds and peak memory of every stage."""
    names = [str(s["name"]) for s in stages]
    figure, axes = new_figure(7.2, 0.34 * len(names) + 0.9, ncols=2, sharey=True)
    y = np.arange(len(names))
    for axis, key, unit in zip(axes, ("seconds", "peak_mb"), ("s", "MiB"), strict=True):
        values = [float(s[key]) for s in stages]
        axis.barh(y, values, 0.6, color=colour("default" if key == "seconds" else "lambertian"))
        for at, value in zip(y, values, strict=True):
            axis.text(value, at, f" {value:.3g} {unit}" if value < 100 else f" {value:.0f} {unit}", va="center", size=8)
        axis.margins(x=0.25)
        axis.grid(False, axis="y")
    axes[0].set_yticks(y, names)
    axes[0].set_ylim(len(names) - 0.4, -0.6)
    axes[0].set_xlabel("seconds")
    axes[1].set_xlabel("peak memory, MiB")
    return figure


def balance_figure(balance: Mapping[str, Sequence[float]], wavelengths_nm: Sequence[float]) -> Figure:
    """Where the launched light went, per wavelength; shares of the launched power."""
    figure, axis = new_figure(7.2, 0.42 * len(wavelengths_nm) + 1.1)
    y = np.arange(len(wavelengths_nm))
    left = np.zeros(len(y))
    inks = ("#0a4c86", "#56b4e9", "#e6a117", "#9aa0a8", "#d55e00", "#00845f", "#cc79a7")
    for n, (term, values) in enumerate(balance.items()):
        shares = np.asarray(values, float)
        axis.barh(y, shares, 0.62, left=left, color=inks[n % len(inks)], ec="w", label=term)
        for at, start, share in zip(y, left, shares, strict=True):
            if share > 0.06:
                axis.text(
                    start + share / 2,
                    at,
                    f"{100 * share:.1f} %",
                    ha="center",
                    va="center",
                    color="w" if n != 1 else "k",
                    size=8,
                )
        left += shares
    axis.set_yticks(y, [f"{w:g} nm" for w in wavelengths_nm])
    axis.set_ylim(len(y) - 0.5, -0.5)
    axis.set_xlim(0, max(1.0, float(left.max())))
    axis.set_xlabel("share of the launched power")
    axis.grid(False)
    figure.legend(loc="outside upper left", ncols=min(len(balance), 5))
    return figure
