"""Whether a rig file goes with a scene, with the scene's plan, and with a capture that is to be continued."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hw.base.errors import InputError
from hw.rig.rig_file import EMULATED, PROJECTOR_STEPS, DevicesFile
from pipeline.geometry.nominal_rig import RigConfig
from pipeline.plan.plan import Plan

WAVELENGTH_TOLERANCE_NM = 10.0
# What may change in the middle of a capture, since no image depends on it: where a device is plugged in, how long it is
# waited for, what is refused.
MAY_CHANGE = re.compile(
    r".*\.(port|baud|reach_s|photodiode_limits|black_tolerance_dn)|warm_up_s|power_tolerance|power_meter.*"
)


def require_scene(rig: DevicesFile, scene: RigConfig, path: Path) -> None:
    """Refuse a rig file that is not this scene's rig. Raises: InputError."""

    def wrong(problem: str, key: str, value: object, allowed: object) -> InputError:
        remedy = "take the scene of this rig, or the rig file of this scene"
        return InputError(problem, file=path, key=key, value=value, allowed=str(allowed), remedy=remedy)

    if len(rig.lasers) != len(scene.lasers):
        raise wrong("the scene has other lasers", "lasers", len(rig.lasers), len(scene.lasers))
    for i, (laser, nominal) in enumerate(zip(rig.lasers, scene.lasers, strict=True)):
        if abs(laser.wavelength_nm - nominal.wavelength_nm) > WAVELENGTH_TOLERANCE_NM:
            allowed = f"{nominal.wavelength_nm:g} within {WAVELENGTH_TOLERANCE_NM:g}"
            raise wrong("the scene has another laser", f"lasers[{i}].wavelength_nm", laser.wavelength_nm, allowed)
    names = [camera.name for camera in rig.cameras]
    expected = [camera.name for camera in scene.cameras]
    if names != expected:
        raise wrong("the scene has other cameras", "cameras", names, expected)
    if scene.projector.steps != PROJECTOR_STEPS:
        raise wrong("the board's mirrors have other steps than rig.projector.steps of the scene", "board",
                    PROJECTOR_STEPS, scene.projector.steps)  # fmt: skip


def require_reach(rig: DevicesFile, plan: Plan, path: Path) -> None:
    """Refuse mirror limits that the plan's spots leave, before hours of images and not at the first such spot.

    Raises: InputError.
    """
    for name, limits in (("u", rig.board.limits_u), ("v", rig.board.limits_v)):
        steps = [getattr(aim, name) for aim in plan.spots]
        if steps and not limits[0] <= min(steps) <= max(steps) <= limits[1]:
            outside = sum(not limits[0] <= step <= limits[1] for step in steps)
            raise InputError(
                f"{outside} of the scene's {len(steps)} spots lie outside",
                file=path,
                key=f"board.limits_{name}",
                value=limits,
                allowed=f"at most {min(steps)} and at least {max(steps)}",
                remedy="widen the limits if the beam is safe there, or correct rig.projector in the scene",
            )


# ---- against the capture that is to be continued


def require_same(rig: DevicesFile, begun_with: DevicesFile, path: Path) -> None:
    """Refuse to continue a capture with another rig than it was begun with: its images would not belong together.

    Raises: InputError.
    """
    now, then = dict(_leaves(rig.model_dump())), dict(_leaves(begun_with.model_dump()))
    for key in [*then, *(key for key in now if key not in then)]:
        if not _same(key, now, then):
            was = f"was begun with {_words(then.get(key))}" if key in then else "was begun without it"
            problem, remedy = f"the capture in this folder {was}", "set it back, or choose another --out"
            raise InputError(problem, file=path, key=key, value=now.get(key, "nothing"), remedy=remedy)


def _same(key: str, now: Mapping[str, Any], then: Mapping[str, Any]) -> bool:
    if key.endswith(".port") and not key.startswith("power_meter"):
        return (now.get(key) == EMULATED) == (then.get(key) == EMULATED)
    if key.startswith("cameras") and key.endswith(".address"):
        serial = key.replace(".address", ".serial")  # identifies the camera, wherever it is
        return now.get(key) == then.get(key) or now.get(serial) == then.get(serial) is not None
    return MAY_CHANGE.fullmatch(key) is not None or now.get(key) == then.get(key)


def _words(value: object) -> str:
    return "none" if value is None else str(list(value)) if isinstance(value, tuple) else repr(value)


def _leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """`lasers[0].power_mw` and its value, for every value of nested tables."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _leaves(inner, f"{key}.{name}" if key else name)
    elif isinstance(value, tuple) and value and isinstance(value[0], dict):
        for number, inner in enumerate(value):
            yield from _leaves(inner, f"{key}[{number}]")
    else:
        yield key, value
