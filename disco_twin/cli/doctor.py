"""`disco-twin doctor`: what is installed, whether it renders, and the remedy for what is missing."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from hw.base.children import child_environment, code_command
from hw.base.resources import total_memory_gb, usable_cores

PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "trimesh", "embreex", "pydantic", "matplotlib", "OpenEXR")
RENDER_TIMEOUT_S = 120.0
MEMORY_GB = 6.0  # what the demo needs
DISK_GB = 2.0
ANSI = re.compile(r"\x1b\[[0-9;]*m")  # Mitsuba colours its output even into a pipe

# Runs in a process of its own: a bad LLVM aborts the process, which no exception handler survives. The maximum of two
# floats is what LLVM 14 and 15 cannot compile.
RENDER = """
from disco_twin.light.backend import activate
backend = activate()
import drjit as dr
import mitsuba as mi
scene = mi.load_dict({"type": "scene", "shape": {"type": "sphere"}, "light": {"type": "constant"},
    "integrator": {"type": "direct"}, "sensor": {"type": "perspective",
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 16, "height": 16}}})
mean = dr.mean(dr.maximum(mi.render(scene, spp=4), 0.0), axis=None)
assert 0.1 < float(mean.array[0]) <= 1.01, f"the image's mean is {mean}"
print(backend)
"""


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    name: str
    good: bool
    detail: str
    remedy: str = ""

    def __str__(self) -> str:
        tail = f". Remedy: {self.remedy}" if self.remedy and not self.good else ""
        return f"{'ok' if self.good else '!!'}  {self.name:<10} {self.detail}{tail}"


def examine(folder: Path, timeout_s: float = RENDER_TIMEOUT_S) -> list[Finding]:
    """Everything that a run needs, `folder` being where it will write."""
    return [_python(), *map(package, PACKAGES), render(timeout_s), _machine(), _disk(folder)]


def _python() -> Finding:
    detail = f"{platform.python_version()} on {platform.platform(terse=True)}"
    return Finding("python", sys.version_info >= (3, 11), detail, "Python 3.11 or newer")


def package(name: str) -> Finding:
    """Whether a package is installed, and its version."""
    try:
        return Finding(name, True, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Finding(name, False, "is not installed", f"pip install {name}, or make install in a checkout")


def render(timeout_s: float) -> Finding:
    """A small render in a subprocess."""
    remedy = "see the message; `pip install karellen-llvm-core` brings a libLLVM that works"
    try:
        done = subprocess.run(
            code_command(RENDER), capture_output=True, encoding="utf-8", errors="replace", timeout=timeout_s,
            check=False, env=child_environment(),
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return Finding("render", False, f"a small render did not end within {timeout_s:g} s", remedy)
    if done.returncode == 0:
        return Finding("render", True, ANSI.sub("", done.stdout).strip().splitlines()[-1])
    lines = ANSI.sub("", done.stderr.strip() or done.stdout).strip().splitlines()
    last = lines[-1].removeprefix("disco_twin.light.backend.BackendError: ") if lines else "no message"
    if done.returncode < 0:
        return Finding("render", False, f"the renderer was killed by signal {-done.returncode}: {last}", remedy)
    return Finding("render", False, last, "" if "Remedy" in last else remedy)


def _machine() -> Finding:
    memory, remedy = total_memory_gb(), f"the demo needs {MEMORY_GB:g} GiB; `--profile small` needs less"
    return Finding("machine", memory >= MEMORY_GB, f"{usable_cores()} cores, {memory:.1f} GiB of memory", remedy)


def _disk(folder: Path) -> Finding:
    there = next(p for p in (folder.resolve(), *folder.resolve().parents) if p.exists())
    if not os.access(there, os.W_OK | os.X_OK):
        return Finding(
            "disk", False, f"{there} cannot be written to", "change into another folder, or name another --out"
        )
    free = shutil.disk_usage(there).free / 1024**3
    return Finding("disk", free >= DISK_GB, f"{free:.1f} GiB free at {there}", f"free {DISK_GB:g} GiB")
