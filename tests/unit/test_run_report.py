"""The report is one self-contained page that shows everything it was given."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from disco_twin.figures import Comparison, Impulse
from disco_twin.report import ReportData, render, rms, write_report

METHODS = {"default": 0.06, "disco2004": 0.15, "dipole": 0.25, "lambertian": 0.6}
LIGHTS = ("uniform", "directional", "edge", "behind", "projector", "spot", "environment")


def fake_data() -> ReportData:
    """A run of made-up figures: a shaded disc, exponential R_d."""
    random = np.random.default_rng(1)
    y, x = np.mgrid[0:124, 0:192]
    r2 = ((x - 96) ** 2 + (y - 62) ** 2) / 50.0**2
    mask = r2 < 1
    shade = np.where(mask, np.sqrt(np.clip(1 - r2, 0, 1)), 0.0)
    comparisons, rows = [], []
    for light in LIGHTS:
        for view in ("left", "low"):
            reference = (np.stack([shade, 0.8 * shade**1.3, 0.5 * shade**1.6]) * 0.2).astype(np.float32)
            relit = {
                m: (reference * (1 + e * random.normal(size=mask.shape))).astype(np.float32) for m, e in METHODS.items()
            }
            comparisons.append(Comparison(light, view, reference, relit, mask, 0.33, METHODS))
            for method, error in METHODS.items():
                rows.append(
                    {
                        "light": light,
                        "view": view,
                        "method": method,
                        "nrmse": error * random.uniform(0.7, 1.4),
                        "nrmse_se": 0.004,
                        "nrmse_floor": 0.02,
                        "psnr": 31.2,
                        "energy_ratio": 1.01,
                    }
                )
    distance = random.uniform(0, 50, (8, 300))
    truth = np.exp(-distance / np.array([6.0, 5.0, 4.0])[:, None, None]) * 3e-2 * random.lognormal(0, 0.3, (3, 8, 300))
    decades = ("0", "-1", "-2", "-3")
    impulse = (1e-1 * np.exp(-40 * r2) + 1e-5 * mask).astype(np.float32)
    summary = {
        "format_version": 1,
        "scene": "quick <&>",
        "seed": 1,
        "method": "default",
        "stages": [
            {"name": n, "seconds": s, "peak_mb": 300 + 3 * s}
            for n, s in [
                ("scan", 2.0),
                ("capture", 95.0),
                ("truth", 40.0),
                ("references", 0.3),
                ("pipeline", 30.0),
                ("scores", 2.0),
            ]
        ],
        "capture": {
            "images": 1806,
            "views": 6,
            "spots": 300,
            "wavelengths": 3,
            "bytes_raw": 129e6,
            "bytes_stored": 11e6,
        },
        "relit": rows,
        "reflectance": {
            "log10_rmse_by_decade": {d: 0.05 + 0.1 * k for k, d in enumerate(decades)},
            "coverage_by_decade": {d: 0.9 - 0.15 * k for k, d in enumerate(decades)},
        },
        "left_out": [
            {"what": "pose search", "because": "the poses are those of the nominal rig, and <deviation> is off"}
        ],
    }
    return ReportData(
        summary=summary,
        wavelengths_nm=(635.0, 532.0, 476.0),
        main="default",
        impulses=[[Impulse(c, s, impulse, 0.33) for s in (3, 120, 280)] for c in ("front", "back")],
        comparisons=comparisons,
        distance=distance,
        truth=truth,
        models={"default": truth * 1.05, "disco2004": truth * 0.8},
        decades={
            m: {
                "measured": {d: 0.05 + 0.1 * k for k, d in enumerate(decades)},
                "completed": {d: 0.1 + 0.12 * k if k < 3 else None for k, d in enumerate(decades)},
                "coverage": {d: 0.9 - 0.15 * k for k, d in enumerate(decades)},
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


def test_the_page_is_self_contained_and_complete(tmp_path: Path) -> None:
    write_report(fake_data(), tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert not re.findall(r"(?:src|href)=['\"](?!data:)|https?://|url\(|<script", page)
    for light in LIGHTS:
        assert f"<h3>{light}</h3>" in page
    for heading in ("Impulse responses", "Relit images", "Errors", "Diffuse subsurface", "Time, memory", "left out"):
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
