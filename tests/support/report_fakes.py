"""What a report is tested with: results of a run that never was."""

from __future__ import annotations

import itertools

import numpy as np

from disco_twin.report.figures import Comparison, Impulse
from disco_twin.report.page import ReportData

METHODS = {"default": 0.06, "disco2004": 0.15, "dipole": 0.25, "lambertian": 0.6}


LIGHTS = ("uniform", "directional", "edge", "behind", "projector", "spot", "environment")


DECADES = ("0", "-1", "-2", "-3")


ERRORS = {"independent": 12.0, "alike": 0.6}


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
        totals={
            m: {
                "lit": {
                    "columns": 20,
                    "mean": [1.01] * 3,
                    "mean_se": [0.01] * 3,
                    "spread": [0.05] * 3,
                    "spread_se": [0.008] * 3,
                },
                "unlit": {
                    "columns": 1,
                    "mean": [0.92] * 3,
                    "mean_se": [None] * 3,
                    "spread": [None] * 3,
                    "spread_se": [None] * 3,
                },
            }
            for m in METHODS
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
            row |= {"nrmse_se": 0.004, "nrmse_floor": 0.02, "psnr": 31.2, "energy_ratio": 1.01}
            rows.append({**row, "rim_nrmse": 3 * error, "rim_nrmse_se": 0.02})
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
            "log10_rmse_all_by_decade": {d: 0.1 + 0.1 * k for k, d in enumerate(DECADES)},
            "coverage_by_decade": {d: 0.9 - 0.15 * k for k, d in enumerate(DECADES)},
            "totals": None,
        },
        "z": {
            "entries": {d: {"count": 400, "rms": 1.2, "beyond_3": 0.01} for d in DECADES},
            "totals": {
                name: {errors: {"count": 60, "rms": rms, "beyond_3": 0.2} for errors, rms in ERRORS.items()}
                for name in ("lit", "unlit")
            },
            "pixels": {
                light: {errors: {"count": 9000, "rms": rms, "beyond_3": 0.2} for errors, rms in ERRORS.items()}
                for light in LIGHTS
            },
        },
        "neck": {
            direction: {
                "columns": 9,
                "truth": [0.02] * 3,
                "truth_se": [0.001] * 3,
                "methods": {"default": [0.03] * 3, "lambertian": [0.0] * 3},
            }
            for direction in ("along_normal", "against_normal")
        },
        "left_out": [
            {"what": "pose search", "because": "the poses are those of the nominal rig, and <deviation> is off"}
        ],
    }
