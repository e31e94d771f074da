"""The report's section on the calibration: what each part found, how well it knows it, and what it left out."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

Found = Mapping[str, Any]
Row = tuple[str, str, str]  # what, figure, remark

COLUMNS = "<colgroup><col style='width:20%'><col style='width:38%'><col></colgroup>"
INTRODUCTION = (
    "What the pipeline found out about the rig from its own images alone: boards and a white plate, the object's "
    "silhouettes, and the laser spots. The figure after +- is one standard deviation, as the calibration states it "
    "itself; the twin's truth is not used here."
)
NOT_MEASURED = {
    "nominal": "Not measured: the rig's deviation is off, so the nominal figures are the true ones.",
    "given": "Not measured: the calibration was given as a file.",
}


def section(found: Found, wavelengths_nm: Sequence[float]) -> tuple[str, str]:
    """(text, HTML) of the section."""
    if found.get("source") != "measured":
        return NOT_MEASURED.get(str(found.get("source")), "No figures."), ""
    groups = {
        "Lenses, from chessboards": _lenses(found),
        "Brightness, from exposures of a board, the white plate and the photodiode": _brightness(found, wavelengths_nm),
        "The object before the cameras, from silhouettes": _poses(found),
        "The projector, from laser spots": _projector(found["projector"]),
    }
    parts = []
    for title, rows in groups.items():
        body = "".join(
            f"<tr><td>{html.escape(what)}</td><td class='text'>{html.escape(figure)}</td>"
            f"<td class='text'>{html.escape(remark)}</td></tr>"
            for what, figure, remark in rows
        )
        parts.append(f"<h3>{html.escape(title)}</h3><table>{COLUMNS}{body}</table>")
    return INTRODUCTION, "".join(parts)


def _lenses(found: Found) -> Iterator[Row]:
    for lens in found["lenses"]:
        share = lens["focal_error_px"] / lens["focal_px"]
        yield (
            f"focal length, {lens['camera']}",
            f"{lens['focal_px']:.1f} +- {lens['focal_error_px']:.1f} px ({share:.2%})",
            f"corners of {lens['boards']} boards meet within {lens['reprojection_px']:.3f} px rms",
        )
        yield (
            f"principal point, {lens['camera']}",
            ", ".join(_pm(*x, 1) for x in zip(lens["centre_px"], lens["centre_error_px"], strict=True)) + " px",
            f"radial distortion k1 {_pm(lens['k1'], lens['k1_error'], 3)}",
        )


def _brightness(found: Found, wavelengths_nm: Sequence[float]) -> Iterator[Row]:
    if found["response"]:
        response = found["response"]
        yield (
            "the camera's response",
            f"known to {response['error_share']:.2%}",
            f"half of the digital range stands for {response['exposure_at_half_range']:.1%} of the full well",
        )
    light = found["photometric"]
    for camera, factors in light["white_balance"].items():
        pairs = zip(factors, light["white_balance_error"][camera], strict=True)
        yield f"white balance, {camera}", ", ".join(_pm(*x, 4) for x in pairs), "a factor per laser"
    for k, nm in enumerate(wavelengths_nm):
        yield (
            f"power of the laser at {nm:.0f} nm",
            f"{1e3 * light['power_w'][k]:.3g} mW",
            f"drifted by {light['power_drift'][k]:.0%} of its mean; single exposures of the plate scatter by "
            f"{light['power_scatter'][k]:.2%} once the photodiode is divided out (speckle)",
        )


def _poses(found: Found) -> Iterator[Row]:
    silhouettes = found["silhouettes"]
    for pose in found["poses"]:
        yield (
            f"pose, {pose['camera']}",
            f"+- {pose['across_error_mm']:.2f} mm across, +- {pose['depth_error_mm']:.2f} mm along the axis, "
            f"+- {pose['rotation_error_deg']:.3f} deg",
            "the worst of its views; the lens's part in it is counted",
        )
    if found["axis"]:
        axis = found["axis"]
        tilts = zip(axis["tilt_deg"], axis["tilt_error_deg"], strict=True)
        places = zip(axis["offset_mm"], axis["offset_error_mm"], strict=True)
        yield (
            "turntable's axis",
            f"tilt {', '.join(_pm(*x, 3) for x in tilts)} deg; passes {', '.join(_pm(*x, 3) for x in places)} mm",
            "about x, y; beside the object's origin in x, y; one axis for all views",
        )
    yield (
        "edges of the silhouettes",
        f"{silhouettes['residual_px']:.3f} px rms",
        f"{silhouettes['edges']} edges; between {min(silhouettes['xor_px'])} and {max(silhouettes['xor_px'])} pixels "
        "a view differ from the scan's mask",
    )
    if silhouettes.get("scan_error_alike_mm"):  # runs of earlier versions lack it
        yield (
            "the scan's own error",
            f"{silhouettes['scan_error_mm']:.3f} mm, alike over {silhouettes['scan_error_alike_mm']:.0f} mm",
            "as the edges show it over whole patches; it is counted in the poses' errors",
        )
    else:
        yield "the scan's own error", "not known", "no two edges are near enough to each other to tell"
    for text in silhouettes["ambiguity"]:
        yield "left open", text, "the silhouettes cannot tell"


def _projector(found: Found) -> Iterator[Row]:
    yield (
        "spots",
        f"{found['used']} used, {found['hidden']} hidden, {found['false']} false",
        f"of {found['images']} images; hidden ones show the glow beside the spot, not the spot itself",
    )
    yield (
        "where a spot is predicted",
        f"+- {found['spot_error_mm']:.3f} mm",
        f"single spots scatter by {found['residual_mm']:.3f} mm rms about the two-mirror model",
    )
    yield (
        "direction of incidence",
        f"+- {found['direction_error_deg']:.3f} deg",
        f"distance of the projector +- {found['distance_error_mm']:.2f} mm",
    )
    angles = zip(found["full_angle_deg"], found["full_angle_error_deg"], strict=True)
    yield "full angle of the mirrors", ", ".join(_pm(*x, 4) for x in angles) + " deg", "over all steps, u and v"
    shift, error = found["peak_shift_mm"], found["peak_shift_error_mm"]
    yield (
        "shift of the peak (Godin et al. 2001)",
        f"{_pm(shift['per_sine'], error['per_sine'], 3)} mm sin(t) + "
        f"{_pm(shift['per_cubed_sine'], error['per_cubed_sine'], 3)} mm sin(t)^3",
        "along the light's way and towards the camera, t from the normal: light leaves the surface beside the beam",
    )


def _pm(value: float, error: float, digits: int) -> str:
    return f"{value:.{digits}f} +- {error:.{digits}f}"
