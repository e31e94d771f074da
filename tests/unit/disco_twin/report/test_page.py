"""The report is one self-contained page that shows everything it was given."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_fakes import LIGHTS, fake_data

from disco_twin.evaluate.summary import rms
from disco_twin.report.figures import TRUTH, colour, marker
from disco_twin.report.page import ReportData, render, write_report
from hw.base.arrays import F64


def test_the_page_is_self_contained_and_complete(tmp_path: Path) -> None:
    write_report(fake_data(), tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert not re.findall(r"(?:src|href)=['\"](?!data:|#|view\.html)|https?://|url\(|<script", page)
    linked, headed = re.findall(r'href="#([^"]+)"', page), re.findall(r'<h2 id="([^"]+)"', page)
    assert linked == headed == sorted(set(headed), key=headed.index)
    order = ["impulse-responses", "relit-images", "errors", "diffuse-subsurface-reflectance"]
    assert headed[:4] == order  # captures, relit beside reference, curves and tables
    for light in LIGHTS:
        assert f"<h3>{light}</h3>" in page
    for heading in (
        "Impulse responses",
        "Relit images",
        "Errors",
        "Diffuse subsurface",
        "Head and body",
        "z-scores",
        "Calibration",
        "Time, memory",
        "left out",
    ):
        assert heading in page
    assert page.count("<img") == len(LIGHTS) + 7
    assert "pose search" in page
    assert "<tr><td>along normal</td><td>9</td><td>0.020 ± 0.001, 0.020 ± 0.001, 0.020 ± 0.001</td>" in page
    assert "<td>totals of lit columns</td><td>independent</td><td>60</td><td>12.00</td>" in page
    assert "quick &lt;&amp;&gt;" in page
    assert "<deviation>" not in page
    assert len(page) < 3e6


def seen_as(rgb: F64, kind: str) -> F64:
    """L, a, b of colours as a dichromat sees them (Machado, Oliveira, Fernandes 2009, table 1, severity 1)."""
    matrix = {
        "all": np.eye(3),
        "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
        "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    }[kind]
    linear = np.clip(np.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92) @ np.transpose(matrix), 0, 1)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = np.cbrt(linear @ to_xyz.T / [0.9505, 1.0, 1.089]).T
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


@pytest.mark.parametrize("kind", ["all", "protan", "deutan"])
def test_methods_are_told_apart_by_colour_and_in_print_by_marks(kind: str) -> None:
    """Every two colours differ by 15 in CIELAB (one is the least that eyes see), white and the truth's ink included."""
    names = ["#ffffff", TRUTH, *(colour(name) for name in ("default", "disco2004", "dipole", "lambertian"))]
    rgb = np.array([[int(name[n : n + 2], 16) / 255 for n in (1, 3, 5)] for name in names])
    lab = seen_as(rgb, kind)
    apart = np.linalg.norm(lab[:, None] - lab, axis=-1)[np.triu_indices(len(lab), 1)]
    assert apart.min() > 15
    assert len({marker(place) for place in range(4)}) == 4


def test_errors_against_outside_references_are_shown_where_there_are_some() -> None:
    data = replace(fake_data(), impulses=(), comparisons=(), distance=None)
    assert "volpath" not in render(data)
    light = LIGHTS[0]
    outside = {"volpath_nrmse": 0.123, "volpath_nrmse_se": 0.004}
    rows = [row | (outside if row["light"] == light else {}) for row in data.summary["relit"]]
    page = render(replace(data, summary={**data.summary, "relit": rows}))
    table = page.split(">Errors</h2>")[1].split("</table>")[0]
    assert "<th>volpath, default</th>" in table
    lines = {row.split("</td>")[0].removeprefix("<td>"): row for row in table.replace("\n", "").split("<tr>")}
    assert lines[light].count("<td>0.123</td></tr>") == 1
    assert all(lines[other].endswith("<td>-</td></tr>") for other in LIGHTS if other != light)
    assert "<th>volpath_nrmse_se</th>" in page


def test_a_run_with_little_to_show_still_gets_its_page() -> None:
    data = fake_data()
    summary = {**data.summary, "relit": [], "left_out": []}
    summary["reflectance"] = {"log10_rmse_by_decade": {}, "coverage_by_decade": {}}
    summary["z"] = None
    del summary["neck"]
    page = render(ReportData(summary=summary, wavelengths_nm=(635.0,), main="default"))
    assert "Nothing: this scene needs every step" in page


def test_rms_keeps_the_sign_of_the_square() -> None:
    assert rms([3.0, 4.0]) == pytest.approx(np.sqrt(12.5))
    assert rms([-0.1]) == pytest.approx(-0.1)
    assert rms([0.1, -0.1]) == pytest.approx(0.0)


MEASURED: dict[str, Any] = {
    "source": "measured",
    "lenses": [
        {
            "camera": "front",
            "boards": 25,
            "reprojection_px": 0.044,
            "focal_px": 1405.4,
            "focal_error_px": 2.7,
            "centre_px": [96.6, 61.5],
            "centre_error_px": [1.2, 1.4],
            "k1": -0.076,
            "k1_error": 0.031,
        }
    ],
    "response": {"exposure_at_half_range": 0.24, "error_share": 0.0017, "chi2": 1.0},
    "photometric": {
        "white_balance": {"front": [0.9915]},
        "white_balance_error": {"front": [0.0031]},
        "power_w": [0.00893],
        "power_drift": [0.35],
        "power_scatter": [0.0088],
    },
    "silhouettes": {
        "residual_px": 0.037,
        "edges": 2380,
        "scan_error_mm": 0.0645,
        "scan_error_alike_mm": 10.0,
        "xor_px": [16, 30],
        "ambiguity": ["rotation about <z>"],
    },
    "scan": {
        "moved_mm": 0.0821,
        "error_mm": 0.0512,
        "edge_px": 0.027,
        "chi2_before": 41.2,
        "chi2_after": 0.81,
        "left_out": None,
    },
    "poses": [{"camera": "front", "rotation_error_deg": 0.087, "across_error_mm": 0.43, "depth_error_mm": 0.86}],
    "axis": {
        "tilt_deg": [-0.011, 0.013],
        "tilt_error_deg": [0.015, 0.012],
        "offset_mm": [-0.08, -0.04],
        "offset_error_mm": [0.001, 0.001],
    },
    "projector": {
        "images": 180,
        "hidden": 91,
        "false": 3,
        "used": 86,
        "residual_mm": 0.039,
        "spot_error_mm": 0.033,
        "distance_error_mm": 1.47,
        "direction_error_deg": 0.085,
        "full_angle_deg": [5.9854, 6.0066],
        "full_angle_error_deg": [0.014, 0.0145],
        "peak_shift_mm": {"per_sine": 0.089, "per_cubed_sine": 0.102},
        "peak_shift_error_mm": {"per_sine": 0.033, "per_cubed_sine": 0.036},
    },
}


def calibration_section(found: dict[str, Any]) -> str:
    """The calibration's section of a page that shows little else."""
    summary = {**fake_data().summary, "relit": [], "calibration": found}
    page = render(ReportData(summary=summary, wavelengths_nm=[635.0], main="default"))
    return page.split(">Calibration</h2>")[1].split("</section>")[0]


def test_a_measured_calibration_is_shown_with_its_uncertainty() -> None:
    shown = calibration_section(MEASURED)
    for text in (
        "standard deviation",
        "1405.4 ± 2.7 px (0.19 %)",
        "0.9915 ± 0.0031",
        "known to 0.17 %",
        "24.0 % of the full well",
        "8.93 mW",
        "drifted by 35 %",
        "± 0.43 mm across, ± 0.86 mm along the axis, ± 0.087°",
        "tilt -0.011 ± 0.015, 0.013 ± 0.012°",
        "between 16 and 30 pixels",
        "0.065 mm, alike over 10 mm",
        "rotation about &lt;z&gt;",
        "moved by 0.082 mm rms, then known to ± 0.051 mm",
        "41.2 before, 0.81 after",
        "86 used, 91 hidden, 3 false",
        "± 0.033 mm",
        "0.089 ± 0.033 mm sin(t) + 0.102 ± 0.036 mm sin(t)³",
    ):
        assert text in shown


def test_the_calibration_shows_only_what_was_found() -> None:
    """One angle has no axis; a linear camera no response; runs of earlier versions no length of the scan's error."""
    assert "turntable" not in calibration_section(MEASURED | {"axis": None})
    assert "response" not in calibration_section(MEASURED | {"response": None})
    outline = dict(MEASURED["silhouettes"])
    for unknown in (outline | {"scan_error_alike_mm": 0.0}, {k: outline[k] for k in outline if "alike" not in k}):
        assert "own error</td><td>not known" in calibration_section(MEASURED | {"silhouettes": unknown})
    left = MEASURED | {"scan": MEASURED["scan"] | {"left_out": "silhouettes and scan agree"}}
    assert "left as it is</td><td>silhouettes and scan agree" in calibration_section(left)
    assert "the scan's surface" not in calibration_section({k: v for k, v in MEASURED.items() if k != "scan"})
    for source, reason in (("nominal", "deviation is off"), ("given", "given as a file"), ("other", "No figures")):
        shown = calibration_section({"source": source})
        assert reason in shown
        assert "<table" not in shown


HOSTILE = """<script>alert("1")</script>'ü"""
ESCAPED = "&lt;script&gt;alert(&#34;1&#34;)&lt;/script&gt;&#39;ü"


def test_text_from_files_is_escaped_wherever_it_stands() -> None:
    """Names of scene, light, view, method, camera; notes and reasons: as text, in attributes too."""
    data = fake_data()
    rows = [{**row, "light": HOSTILE, "view": HOSTILE, "method": HOSTILE} for row in data.summary["relit"][:1]]
    lens = MEASURED["lenses"][0] | {"camera": HOSTILE}
    omission = {"what": HOSTILE, "because": HOSTILE}
    found = MEASURED | {"lenses": [lens]}
    summary = {**data.summary, "scene": HOSTILE, "relit": rows, "calibration": found, "left_out": [omission]}
    comparison = replace(data.comparisons[0], light=HOSTILE, relit={HOSTILE: data.comparisons[0].relit["default"]})
    data = replace(data, wavelengths_nm=[635.0], summary=summary, main=HOSTILE, comparisons=[comparison])
    page = render(replace(data, notes=[HOSTILE], decades={}, truth=None, balance={}))
    assert "<script" not in page
    assert f'alt="{ESCAPED}"' in page
    places = {"head": 4, "relit": 2, "errors": 7, "neck": 1, "z": 1, "calibration": 2, "left out": 2}
    assert page.count(ESCAPED) == sum(places.values())
