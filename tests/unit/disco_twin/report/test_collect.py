"""What cannot be scored or shown is left out with a word, and never ends a run."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from damaged_images import damaged_images
from reconstruct_capture import SENSOR, rig, write_capture
from report_fakes import METHODS, fake_data
from rich.console import Console
from scene_fakes import sphere

from disco_twin.cli.tables import score_table
from disco_twin.evaluate.scores import KEPT, RIM, usable_score
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.pipeline_process import pipeline_inputs
from disco_twin.report.collect import SPOTS_SHOWN, impulses
from disco_twin.report.page import render
from disco_twin.run.scan import require_capturable, write_scan
from disco_twin.scene.scene import Neck
from hw.base.errors import InputError
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.stream.stream import StreamReader

ONES = np.ones((2, 16, 16), np.float32)
MASK = np.ones((16, 16), bool)


def test_what_cannot_be_scored_is_none_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    nothing = dict.fromkeys(KEPT)
    with caplog.at_level(logging.WARNING):
        assert usable_score("case 1", ONES, ONES, ONES, ~MASK) == nothing
        assert usable_score("case 2", ONES, 0 * ONES, 0 * ONES, MASK) == nothing
        assert usable_score("case 3", np.nan * ONES, ONES, ONES, MASK) == nothing
    assert [record.getMessage()[:19] for record in caplog.records] == [f"no score for case {n}" for n in (1, 2, 3)]
    score = usable_score("good", 1.1 * ONES, ONES, ONES, MASK)
    assert score["nrmse"] == pytest.approx(0.1)


def test_the_report_and_the_table_show_a_dash_where_there_is_no_score() -> None:
    data = fake_data()
    none = dict.fromkeys((*KEPT, *(f"rim_{key}" for key in RIM)))
    rows = [r | (none if r["light"] == "edge" else {}) for r in data.summary["relit"]]
    data = replace(data, summary={**data.summary, "relit": rows}, impulses=(), comparisons=(), distance=None)
    page = render(data)
    assert "<tr><td>edge</td>" + "<td>-</td>" * len(METHODS) + "<td>- / -</td><td>-</td>\n<td>-</td></tr>" in page
    assert "nan" not in page.split(">Errors</h2>")[1].split("<figure>")[0]
    page = render(replace(data, summary={**data.summary, "relit": [r | dict.fromkeys(KEPT) for r in rows]}))
    assert "<b>-</b><span>nrmse under broad light" in page
    out = StringIO()
    Console(file=out, width=200).print(score_table({"relit": rows}))
    lines = {line.split()[0]: line.split()[1:] for line in out.getvalue().splitlines() if line.strip()}
    assert lines["edge"] == ["-"] * len(METHODS)
    assert all(float(x) > 0 for x in lines["spot"])


def test_the_report_leaves_out_a_spot_whose_image_is_damaged(tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    write_capture(capture)
    whole, damaged = impulses(rig(), capture, SENSOR)
    assert [len(row) for row in whole] == [SPOTS_SHOWN] * 2
    assert not damaged
    with StreamReader(capture) as stream:
        spot = whole[1][1].spot
        index = next(i for i, a in enumerate(stream.plan.addresses()) if (a.spot, a.laser) == (spot, 0))
        entry = stream._entry(index)
        middle = entry.payload_offset + entry.payload_bytes // 2
    with (capture / "images.bin").open("r+b") as file:
        file.seek(middle)
        byte = file.read(1)[0]
        file.seek(middle)
        file.write(bytes([byte ^ 4]))
    with StreamReader(capture) as stream:
        assert damaged_images(stream) == [index]
    rest, damaged = impulses(rig(), capture, SENSOR)
    assert [[i.spot for i in row] for row in rest] == [[i.spot for i in row if i.spot != spot] for row in whole]
    assert len(damaged) == 1
    assert f"spot {spot} is not shown: image {index}" in damaged[0]


def test_a_held_out_view_must_see_the_object(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"relight\.views\[1\].*'c' does not see the object|does not see.*views\[1\]"):
        write_scan(sphere(aim=(450.0, 0.0, 500.0)), tmp_path)
    assert not any(tmp_path.iterdir())


def test_a_neck_lies_in_the_object() -> None:
    def with_neck(height: float) -> Experiment:
        scene = sphere().scene
        neck = Neck(through_mm=(0.0, 0.0, height))
        return Experiment(scene.model_copy(update={"relight": scene.relight.model_copy(update={"neck": neck})}))

    with pytest.raises(InputError, match=r"relight\.neck\.through_mm.*allowed: inside \[-20.*Remedy"):
        require_capturable(with_neck(25.0))
    inside = with_neck(12.0)
    np.testing.assert_array_equal(inside.beyond_neck, inside.scan.vertices[:, 2] > 12.0)
    assert "neck" not in pipeline_inputs(inside.scene, ("default",))["relight"]
    assert sphere().beyond_neck is None


def test_the_pipeline_is_not_told_which_faults_are_on(tmp_path: Path) -> None:
    files = []
    for name, faults in (("with", {"deviation": True, "speckle": True}), ("without", {})):
        (tmp_path / name).mkdir()
        write_scan(sphere(faults=faults), tmp_path / name)
        files.append((tmp_path / name / "rig.json").read_bytes())
    assert files[0] == files[1]
    assert "faults" not in json.loads(files[0])["rig"]
    assert CameraConfig.model_validate(json.loads(files[0])["rig"]["cameras"][0]).name == "a"
