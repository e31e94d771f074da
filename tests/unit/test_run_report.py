"""The report is one self-contained page that shows everything it was given."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from disco_twin.figures import Comparison, Impulse
from disco_twin.report import ReportData, render, rms, write_report
from disco_twin.report_calibration import section

METHODS = {"default": 0.06, "disco2004": 0.15, "dipole": 0.25, "lambertian": 0.6}
LIGHTS = ("uniform", "directional", "edge", "behind", "projector", "spot", "environment")


DECADES = ("0", "-1", "-2", "-3")
SECONDS = {"scan": 2.0, "capture": 95.0, "truth": 40.0, "references": 0.3, "pipeline": 30.0, "scores": 2.0}


def fake_data() -> ReportData:
    """A run of made-up figures: a shaded disc, exponential R_d."""
    random = np.random.default_rng(1)
    y, x = np.mgrid[0:124, 0:192]
    r2 = ((x - 96) ** 2 + (y - 62) ** 2) / 50.0**2
    comparisons, rows = fake_images(random, r2)
    distance = random.uniform(0, 50, (8, 300))
    truth = np.exp(-distance / np.array([6.0, 5.0, 4.0])[:, None, None]) * 3e-2 * random.lognormal(0, 0.3, (3, 8, 300))
    impulse = (1e-1 * np.exp(-40 * r2) + 1e-5 * (r2 < 1)).astype(np.float32)
    return ReportData(
        summary=fake_summary(rows),
        wavelengths_nm=(635.0, 532.0, 476.0),
        main="default",
        impulses=[[Impulse(c, s, impulse, 0.33) for s in (3, 120, 280)] for c in ("front", "back")],
        comparisons=comparisons,
        distance=distance,
        truth=truth,
        models={"default": truth * 1.05, "disco2004": truth * 0.8},
        decades={
            m: {
                "measured": {d: 0.05 + 0.1 * k for k, d in enumerate(DECADES)},
                "completed": {d: 0.1 + 0.12 * k if k < 3 else None for k, d in enumerate(DECADES)},
                "coverage": {d: 0.9 - 0.15 * k for k, d in enumerate(DECADES)},
            }
            for m in ("default", "disco2004")
        },
        seconds={"default": 24.0, "disco2004": 21.0, "dipole": 3.0, "lambertian": 1.0},
        balance={
            "specular": (0.06,) * 3,
            "escaped": (0.7, 0.6, 0.5),
            "absorbed": (0.2, 0.3, 0.4),
            "boundary loss": (0.04,) * 3,
        },
        notes=("The rig's deviation is off: poses and projector are the nominal ones.",),
    )


def fake_images(random: np.random.Generator, r2: np.ndarray) -> tuple[list[Comparison], list[dict[str, object]]]:
    """Relit images and rows of scores. r2: (height, width), squared distance from the disc's centre in radii."""
    mask = r2 < 1
    shade = np.where(mask, np.sqrt(np.clip(1 - r2, 0, 1)), 0.0)
    reference = (np.stack([shade, 0.8 * shade**1.3, 0.5 * shade**1.6]) * 0.2).astype(np.float32)
    comparisons, rows = [], []
    for light, view in itertools.product(LIGHTS, ("left", "low")):
        relit = {
            m: (reference * (1 + e * random.normal(size=mask.shape))).astype(np.float32) for m, e in METHODS.items()
        }
        comparisons.append(Comparison(light, view, reference, relit, mask, 0.33, METHODS))
        for method, error in METHODS.items():
            row: dict[str, object] = {"light": light, "view": view, "method": method}
            row["nrmse"] = error * random.uniform(0.7, 1.4)
            rows.append({**row, "nrmse_se": 0.004, "nrmse_floor": 0.02, "psnr": 31.2, "energy_ratio": 1.01})
    return comparisons, rows


def fake_summary(rows: list[dict[str, object]]) -> dict[str, object]:
    """summary.json of such a run."""
    return {
        "format_version": 1,
        "scene": "quick <&>",
        "seed": 1,
        "method": "default",
        "stages": [{"name": n, "seconds": s, "peak_mb": 300 + 3 * s} for n, s in SECONDS.items()],
        "capture": {
            "images": 1806,
            "views": 6,
            "spots": 300,
            "wavelengths": 3,
            "bytes_raw": 129e6,
            "bytes_stored": 11e6,
        },
        "calibration": {"source": "nominal"},
        "relit": rows,
        "reflectance": {
            "log10_rmse_by_decade": {d: 0.05 + 0.1 * k for k, d in enumerate(DECADES)},
            "coverage_by_decade": {d: 0.9 - 0.15 * k for k, d in enumerate(DECADES)},
        },
        "left_out": [
            {"what": "pose search", "because": "the poses are those of the nominal rig, and <deviation> is off"}
        ],
    }


def test_the_page_is_self_contained_and_complete(tmp_path: Path) -> None:
    write_report(fake_data(), tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert not re.findall(r"(?:src|href)=['\"](?!data:)|https?://|url\(|<script", page)
    for light in LIGHTS:
        assert f"<h3>{light}</h3>" in page
    for heading in (
        "Impulse responses",
        "Relit images",
        "Errors",
        "Diffuse subsurface",
        "Calibration",
        "Time, memory",
        "left out",
    ):
        assert heading in page
    assert page.count("<img") == len(LIGHTS) + 7
    assert "pose search" in page
    assert "quick &lt;&amp;&gt;" in page
    assert "<deviation>" not in page
    assert len(page) < 12e6


def test_a_run_with_little_to_show_still_gets_its_page() -> None:
    data = fake_data()
    summary = {**data.summary, "relit": [], "left_out": []}
    summary["reflectance"] = {"log10_rmse_by_decade": {}, "coverage_by_decade": {}}
    page = render(ReportData(summary=summary, wavelengths_nm=(635.0,), main="default"))
    assert "Nothing: this scene needs every step" in page


def test_rms_keeps_the_sign_of_the_square() -> None:
    assert rms([3.0, 4.0]) == pytest.approx(np.sqrt(12.5))
    assert rms([-0.1]) == pytest.approx(-0.1)
    assert rms([0.1, -0.1]) == pytest.approx(0.0)


MEASURED = {
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


def test_the_calibration_is_told_with_its_uncertainty() -> None:
    """Of a measured one every part; of another one why there is nothing to tell. One angle has no axis."""
    text, body = section(MEASURED, [635.0])
    assert "standard deviation" in text
    for shown in (
        "1405.4 +- 2.7 px (0.19%)",
        "0.9915 +- 0.0031",
        "known to 0.17%",
        "drifted by 35%",
        "+- 0.43 mm across, +- 0.86 mm along the axis, +- 0.087 deg",
        "tilt -0.011 +- 0.015, 0.013 +- 0.012 deg",
        "0.065 mm, alike over 10 mm",
        "rotation about &lt;z&gt;",
        "86 used, 91 hidden, 3 false",
        "+- 0.033 mm",
        "0.089 +- 0.033 mm sin(t) + 0.102 +- 0.036 mm sin(t)^3",
    ):
        assert shown in body
    assert "axis</td><td class='text'>tilt" not in section(MEASURED | {"axis": None}, [635.0])[1]
    untold = MEASURED | {"silhouettes": MEASURED["silhouettes"] | {"scan_error_mm": 0.0, "scan_error_alike_mm": 0.0}}
    assert "own error</td><td class='text'>not known" in section(untold, [635.0])[1]
    earlier = {
        k: v for k, v in MEASURED["silhouettes"].items() if k != "scan_error_alike_mm"
    }  # a run made before it was
    assert "own error</td><td class='text'>not known" in section(MEASURED | {"silhouettes": earlier}, [635.0])[1]
    assert section({"source": "nominal"}, [635.0])[1] == ""
    assert "given as a file" in section({"source": "given"}, [635.0])[0]
