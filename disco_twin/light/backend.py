"""Which LLVM and which Mitsuba variant run: chosen once, before drjit is imported, and logged in one line.

Dr.Jit 1.5 emits `llvm.minimum/maximum`. LLVM 14 and 15, which many distributions ship, pass Dr.Jit's own check and
then abort the whole process in the middle of a render; so the library is chosen here and never left to chance.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import logging
import os
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from hw.base.errors import DiscoError

log = logging.getLogger(__name__)

ON_LLVM = "llvm_ad_mono"  # Mitsuba's variant
OLDEST_LLVM = 16
ENVIRONMENT_KEY = "DRJIT_LIBLLVM_PATH"
REMEDY = (
    "pip install karellen-llvm-core, or install libllvm19 (Debian) or llvm (Homebrew), "
    f"or point {ENVIRONMENT_KEY} at a libLLVM of version {OLDEST_LLVM} or newer"
)
TOO_OLD = f"which aborts Dr.Jit 1.5 in the middle of a render (allowed: {OLDEST_LLVM} or newer). Remedy: {REMEDY}"


class BackendError(DiscoError):
    """No usable renderer; the message names the remedy."""


@dataclass(frozen=True)
class Backend:
    """What was chosen and why. `llvm_path` and `llvm_version` are None where the variant does without LLVM."""

    variant: str
    llvm_path: str | None
    llvm_version: int | None
    reason: str

    def __str__(self) -> str:
        llvm = "" if self.llvm_path is None else f" on LLVM {self.llvm_version} ({self.llvm_path})"
        return f"Mitsuba {self.variant}{llvm}: {self.reason}"


_active: Backend | None = None


def llvm_version(path: str) -> int | None:
    """Major version as the library states it (`LLVMGetVersion`, since LLVM 16), else by its name; None: unknown."""
    try:
        library = ctypes.CDLL(path)
    except OSError:
        return None
    if hasattr(library, "LLVMGetVersion"):
        major = ctypes.c_uint()
        library.LLVMGetVersion(ctypes.byref(major), None, None)
        return int(major.value)
    if not hasattr(library, "LLVMContextCreate"):
        return None  # some other library
    named = re.search(r"LLVM(?:-|\.so\.|\.)(\d+)", str(Path(path).resolve().name)) or re.search(r"llvm-(\d+)", path)
    return int(named.group(1)) if named else OLDEST_LLVM - 1  # it lacks LLVMGetVersion: 15 or older


def candidates() -> Iterator[str]:
    """Paths of libLLVM that may be there, best first: the Python environment's own, then the system's, newest first."""
    if sys.platform == "darwin":
        yield from _existing(Path(sys.prefix) / "lib", ["libLLVM.dylib", "libLLVM-*.dylib"])
        for root in ("/opt/homebrew/opt", "/usr/local/opt"):
            yield from _existing(Path(root), ["llvm/lib/libLLVM.dylib", "llvm@*/lib/libLLVM.dylib"])
        return
    yield from _existing(Path(sys.prefix) / "lib", ["libLLVM.so.*", "libLLVM-*.so", "libLLVM.so"])
    system = [Path("/usr/lib"), Path("/usr/lib64"), Path("/usr/lib/wsl/lib")]
    system += sorted(Path("/usr/lib").glob("*-linux-gnu"))
    for folder in system:
        yield from _existing(folder, ["libLLVM.so.*", "libLLVM-*.so*", "libLLVM.so", "llvm-*/lib/libLLVM.so*"])
    for major in range(40, OLDEST_LLVM - 1, -1):  # what the dynamic linker finds
        for name in (f"LLVM-{major}", f"LLVM.so.{major}"):
            if found := ctypes.util.find_library(name):
                yield found
    if found := ctypes.util.find_library("LLVM"):
        yield found


def _existing(folder: Path, patterns: Iterable[str]) -> list[str]:
    """Files in `folder` that match, the highest numbers in their names first."""
    found = {path for pattern in patterns for path in folder.glob(pattern) if path.is_file()}
    return [str(p) for p in sorted(found, key=lambda p: [int(n) for n in re.findall(r"\d+", str(p))], reverse=True)]


def choose_llvm(paths: Iterable[str], chosen_by_user: str | None) -> Backend:
    """The LLVM library to use and the reason. A user's own choice is taken or refused, never replaced.

    Raises: BackendError where no library can be used.
    """
    if chosen_by_user:
        version = llvm_version(chosen_by_user)
        if version is None:
            raise BackendError(f"{ENVIRONMENT_KEY}={chosen_by_user} is no loadable LLVM library. Remedy: {REMEDY}")
        if version < OLDEST_LLVM:
            raise BackendError(f"{ENVIRONMENT_KEY}={chosen_by_user} is LLVM {version}, {TOO_OLD}")
        return Backend(ON_LLVM, chosen_by_user, version, f"chosen by {ENVIRONMENT_KEY}")
    refused: dict[int, str] = {}
    for path in paths:
        version = llvm_version(path)
        if version is None:
            continue
        if version >= OLDEST_LLVM:
            own = path.startswith(str(Path(sys.prefix) / "lib"))
            return Backend(ON_LLVM, path, version, "from this Python environment" if own else "from the system")
        refused.setdefault(version, path)
    if refused:
        raise BackendError(f"only LLVM {', '.join(map(str, sorted(refused)))} found, {TOO_OLD}")
    raise BackendError(f"no LLVM library found. Remedy: {REMEDY}")


def has_cuda_driver() -> bool:
    """Whether a CUDA driver is there and answers with at least one device."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    count = ctypes.c_int(0)
    if driver.cuInit(0) != 0 or driver.cuDeviceGetCount(ctypes.byref(count)) != 0:
        return False
    return count.value > 0


def activate() -> Backend:
    """Choose the backend, set Mitsuba's variant, and log both once. Later calls return the same choice.

    Raises: BackendError where there is no usable renderer.
    """
    global _active
    if _active is not None:
        return _active
    if ENVIRONMENT_KEY not in os.environ and has_cuda_driver():
        backend = Backend("cuda_ad_mono", None, None, "a CUDA driver is present")
    else:
        backend = _on_llvm()
    if backend.llvm_path is not None:
        os.environ[ENVIRONMENT_KEY] = backend.llvm_path
    try:
        import mitsuba as mi  # only now: Dr.Jit loads LLVM when it is imported
    except ImportError as error:
        raise BackendError(
            f"the renderer is not installed ({error}). Remedy: pip install 'mitsuba>=3.9,<3.10'"
        ) from error
    mi.set_variant(backend.variant)
    log.info("%s", backend)
    _active = backend
    return backend


def _on_llvm() -> Backend:
    """With the library to use and why; where drjit is imported already, the one that it holds, if that one works."""
    if "drjit" not in sys.modules:
        return choose_llvm(candidates(), os.environ.get(ENVIRONMENT_KEY))
    import drjit

    version = drjit.detail.llvm_version()
    if not version or int(version[0]) < OLDEST_LLVM:
        held = f"LLVM {version[0]}" if version else "no LLVM"
        raise BackendError(
            f"drjit was imported before disco_twin.light.backend.activate() and holds {held} "
            f"(allowed: {OLDEST_LLVM} or newer). Remedy: call activate() before anything imports drjit or mitsuba"
        )
    path = os.environ.get(ENVIRONMENT_KEY, "libLLVM")
    return Backend(ON_LLVM, path, int(version[0]), "drjit was imported before")
