"""What a measured calibration says about itself, for pipeline.json, summary.json and the report.

All in mm, degrees, pixels, watts and shares; every `_error` is one standard deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hw.base.arrays import F64

if TYPE_CHECKING:
    from pipeline.calibrate.calibrate_rig import RigMeasurement
    from pipeline.calibrate.pose import PoseFit
    from pipeline.calibrate.projector_fit import ProjectorFit
    from pipeline.calibrate.target_images import CameraImages


def figures(found: RigMeasurement) -> dict[str, Any]:
    """Strict JSON, without NaN."""
    views = found.calibration.views
    per_camera = len(views) // len(found.cameras)
    names = [views[c * per_camera].camera for c in range(len(found.cameras))]
    return {
        "source": found.calibration.source,
        "lenses": [_lens(name, c) for name, c in zip(names, found.cameras, strict=True)],
        "response": _response(found),
        "photometric": _photometric(found, names),
        "silhouettes": {
            "residual_px": found.poses.residual_px,
            "edges": found.poses.edges,
            "scan_error_mm": found.poses.surface_mm,
            "scan_error_alike_mm": found.poses.surface_alike_mm,
            "xor_px": list(found.poses.xor_pixels),
            "ambiguity": list(found.poses.ambiguity),
        },
        "scan": _scan(found.poses),
        "poses": _poses(found.poses, names),
        "axis": _axis(found.poses),
        "projector": _projector(found.projector),
    }


def _lens(name: str, images: CameraImages) -> dict[str, Any]:
    found = images.intrinsics
    error = np.sqrt(np.diag(found.covariance))
    return {
        "camera": name,
        "boards": len(found.used),
        "reprojection_px": found.reprojection_px,
        "focal_px": float(found.values[0]),
        "focal_error_px": float(error[0]),
        "centre_px": _floats(found.values[1:3]),
        "centre_error_px": _floats(error[1:3]),
        "k1": float(found.values[3]),
        "k1_error": float(error[3]),
    }


def _response(found: RigMeasurement) -> dict[str, Any] | None:
    """Of a camera that is not linear: error as a share of the exposure, at worst above a fiftieth of the range."""
    if found.response is None:
        return None
    response, low = found.response, len(found.response.exposure) // 50
    middle = float(response.exposure[len(response.exposure) // 2])
    return {
        "exposure_at_half_range": middle,
        "error_share": float((response.error[low:-1] / response.exposure[low:-1]).max()),
        "chi2": response.chi2,
    }


def _photometric(found: RigMeasurement, names: Sequence[str]) -> dict[str, Any]:
    """Per laser, and the white balance per camera; drift and scatter are shares, the largest of all cameras."""
    balances = [c.balance for c in found.cameras]
    return {
        "white_balance": {name: _floats(b.factor) for name, b in zip(names, balances, strict=True)},
        "white_balance_error": {name: _floats(b.error) for name, b in zip(names, balances, strict=True)},
        "power_w": [laser.power_w for laser in found.calibration.lasers],
        "power_drift": _floats(np.max([b.drift for b in balances], axis=0)),
        "power_scatter": _floats(np.max([b.scatter for b in balances], axis=0)),
    }


def _scan(poses: PoseFit) -> dict[str, Any]:
    """Of the scan's surface, rms over its vertices: by how much it was moved, and what remains unknown of it.

    chi2: mean square of what the edges leave, over their own error, before and after; left_out: why it was not moved
    """
    scan = poses.scan
    moved, error = (0.0 if scan.because else float(np.sqrt((x**2).mean())) for x in (scan.displacement, scan.error))
    return {
        "moved_mm": moved,
        "error_mm": error,
        "edge_px": scan.edge_px,
        "chi2_before": scan.chi2_before,
        "chi2_after": scan.chi2_after,
        "left_out": scan.because or None,
    }


def _poses(poses: PoseFit, names: Sequence[str]) -> list[dict[str, Any]]:
    """Per camera, the largest uncertainty of its views: rotation, and the object's place across and along the axis."""
    rotation = np.rad2deg(np.linalg.norm(poses.rotation, axis=1)).reshape(len(names), -1).max(axis=1)
    shift = poses.translation.reshape(len(names), -1, 3).max(axis=1)
    return [
        {
            "camera": name,
            "rotation_error_deg": float(turned),
            "across_error_mm": float(moved[:2].max()),
            "depth_error_mm": float(moved[2]),
        }
        for name, turned, moved in zip(names, rotation, shift, strict=True)
    ]


def _axis(poses: PoseFit) -> dict[str, Any] | None:
    """Of the turntable, against the object's z axis; None where the object was not turned."""
    if not len(poses.axis):
        return None
    return {
        "tilt_deg": _floats(np.rad2deg(poses.axis[:2])),
        "tilt_error_deg": _floats(np.rad2deg(poses.axis_error[:2])),
        "offset_mm": _floats(poses.axis[2:]),
        "offset_error_mm": _floats(poses.axis_error[2:]),
    }


def _projector(fit: ProjectorFit) -> dict[str, Any]:
    """residual_mm: of spots across the beam; direction_error_deg, spot_error_mm: of beams that light the object.

    peak_shift_mm: by which a spot's peak moves along the light's way and towards the camera (Godin et al. 2001), per
    sine of the angle to the normal, and per its cube
    """
    error = np.sqrt(np.diag(fit.covariance))
    return {
        "images": fit.images,
        "hidden": fit.images - fit.sightings,
        "false": int(fit.false.sum()),
        "used": int((~fit.false).sum()),
        "residual_mm": fit.rms_mm,
        "spot_error_mm": float(np.hypot(*error[3:5])),
        "distance_error_mm": float(error[5]),
        "direction_error_deg": float(np.rad2deg(np.linalg.norm(error[:2]))),
        "full_angle_deg": _floats(np.rad2deg(fit.projector.full_angle_rad)),
        "full_angle_error_deg": _floats(np.rad2deg(error[6:8])),
        "peak_shift_mm": {"per_sine": float(fit.shift[0]), "per_cubed_sine": float(fit.shift[1])},
        "peak_shift_error_mm": {"per_sine": float(fit.shift_error[0]), "per_cubed_sine": float(fit.shift_error[1])},
    }


def _floats(values: F64) -> list[float]:
    return [float(x) for x in values]
