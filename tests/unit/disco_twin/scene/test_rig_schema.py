"""The faults of the twin's rig are the twin's alone."""

from __future__ import annotations

import json
from pathlib import Path

from twin_fakes import RIG

from disco_twin.scene.rig_schema import FaultsConfig
from hw.base.config import read_json
from pipeline.records import NominalRigFile


def test_the_nominal_rig_holds_everything_but_the_faults() -> None:
    assert RIG.faults != FaultsConfig()
    assert RIG.nominal().model_dump() == RIG.model_dump(exclude={"faults"})


def test_a_capture_of_before_whose_rig_names_faults_is_still_read(tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    path.write_text(json.dumps({"format_version": 1, "rig": RIG.model_dump(mode="json")}))
    assert read_json(path, NominalRigFile, "").rig == RIG.nominal()
