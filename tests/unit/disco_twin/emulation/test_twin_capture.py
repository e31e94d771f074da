"""Capture loop and simulated rig together: every drift on, and a resumed capture is still the same bytes."""

from __future__ import annotations

from pathlib import Path

import pytest
from capture_fakes import contents
from twin_fakes import PLAN, RIG, Glow

from disco_twin.emulation.twin_rig import TwinRig
from pipeline.capture.loop import capture


@pytest.mark.parametrize("fail_at", [0, 1, 3, 7, 8, 11, 12, 21])
def test_resumed_capture_equals_the_uninterrupted_one(tmp_path: Path, fail_at: int) -> None:
    """Also across a change of view (11 images are one camera) and within a spot."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    capture(TwinRig(RIG, Glow(), seed=5), PLAN, whole)
    with pytest.raises(RuntimeError, match="out of light"):
        capture(TwinRig(RIG, Glow(fail_at), seed=5), PLAN, parts)
    assert capture(TwinRig(RIG, Glow(), seed=5), PLAN, parts) == fail_at
    assert contents(parts) == contents(whole)
