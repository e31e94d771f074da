"""The choice of LLVM, and the doctor. Libraries are stubs compiled by nobody: versions are injected."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from disco_twin.cli import doctor
from disco_twin.light import backend
from disco_twin.light.backend import BackendError, choose_llvm

VERSIONS = {"/a/llvm14": 14, "/a/llvm15": 15, "/a/llvm16": 16, "/a/llvm23": 23, "/a/other": None}


@pytest.fixture(autouse=True)
def _injected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend, "llvm_version", VERSIONS.get)


def test_first_usable_candidate_wins_and_old_ones_are_passed_over() -> None:
    chosen = choose_llvm(["/a/other", "/a/llvm15", "/a/llvm16", "/a/llvm23"], None)
    assert (chosen.llvm_path, chosen.llvm_version, chosen.reason) == ("/a/llvm16", 16, "from the system")


def test_users_choice_is_honoured() -> None:
    chosen = choose_llvm(["/a/llvm23"], "/a/llvm16")
    assert chosen.llvm_path == "/a/llvm16"
    assert "DRJIT_LIBLLVM_PATH" in chosen.reason


@pytest.mark.parametrize("choice", ["/a/llvm14", "/a/llvm15", "/a/other", "/nowhere"])
def test_users_bad_choice_is_refused_with_a_remedy_not_replaced(choice: str) -> None:
    with pytest.raises(BackendError, match=r"(?s)" + choice + r".*Remedy"):
        choose_llvm(["/a/llvm23"], choice)


@pytest.mark.parametrize(("paths", "said"), [(["/a/llvm14", "/a/llvm15"], "only LLVM 14, 15 found"), ([], "no LLVM")])
def test_nothing_usable_names_the_remedy(paths: list[str], said: str) -> None:
    with pytest.raises(BackendError, match=said + r".*Remedy: pip install karellen-llvm-core"):
        choose_llvm(paths, None)


def python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={**{k: v for k, v in os.environ.items() if k != backend.ENVIRONMENT_KEY}, **environment},
    )


def test_activation_is_idempotent_and_says_what_was_chosen() -> None:
    done = python(
        "import logging; logging.basicConfig(level='INFO')\n"
        "from disco_twin.light.backend import activate; a = activate(); assert a is activate(); print(a)\n"
        "import drjit; v = drjit.detail.llvm_version()\n"
        "assert a.variant.startswith('cuda') or v[0] == a.llvm_version >= 16, v"
    )
    assert done.returncode == 0, done.stderr
    assert "ad_mono" in done.stdout
    assert done.stderr.count("Mitsuba") == 1


def test_a_drjit_that_holds_a_bad_library_is_refused() -> None:
    code = (
        "import sys, types; drjit = types.ModuleType('drjit'); drjit.detail = types.SimpleNamespace()\n"
        "drjit.detail.llvm_version = lambda: (15, 0, 6); sys.modules['drjit'] = drjit\n"
        "from disco_twin.light import backend; backend.has_cuda_driver = lambda: False\n"
        "backend.activate()"
    )
    done = python(code)
    assert "holds LLVM 15" in done.stderr
    assert "Remedy: call activate() before" in done.stderr


@pytest.mark.parametrize("code", ["import os; os.abort()", "import time; time.sleep(60)", "raise SystemExit('broken')"])
def test_doctor_survives_a_renderer_that_aborts_hangs_or_fails(code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "RENDER", code)
    finding = doctor.render(timeout_s=2.0)
    assert not finding.good
    assert "Remedy" in str(finding)


def test_doctor_finds_this_environment_sound(tmp_path: Path) -> None:
    findings = {f.name: f for f in doctor.examine(tmp_path / "not" / "yet")}
    assert findings["render"].good, findings["render"]
    assert "ad_mono" in findings["render"].detail
    assert findings["mitsuba"].good
    assert not doctor.package("no-such-package").good
