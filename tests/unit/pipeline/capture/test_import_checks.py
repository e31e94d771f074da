"""Frames, description, scan and silhouettes of a foreign capture that contradict each other: refused before anything
is stored, with the likeliest cause; what agrees is stored, and once.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from hw.base.errors import InputError
from pipeline.capture.import_folder import import_capture, read_frame
from pipeline.capture.poses import pose_warnings, watching
from pipeline.reconstruct.settings import ReconstructConfig
from pipeline.run import Request, run
from pipeline.stream.stream import StreamReader
from tests.support.foreign_captures import HEIGHT, WIDTH, ForeignCapture, foreign_capture

Change = Callable[[ForeignCapture], None]
Pictures = NDArray[np.uint16]
ROWS, COLUMNS = np.arange(HEIGHT)[:, None], np.arange(WIDTH)


@pytest.fixture(scope="module")
def right() -> ForeignCapture:
    return foreign_capture()


def fresh(right: ForeignCapture) -> ForeignCapture:
    capture = ForeignCapture(right.description, right.scan.copy())
    capture.frames = [type(f)(dict(f.row), f.picture.copy()) for f in right.frames]
    return capture


def test_what_agrees_is_imported_without_a_word(
    right: ForeignCapture, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        import_capture(right.write(tmp_path / "theirs"), tmp_path / "x")
    assert not caplog.records and pose_warnings(tmp_path / "x") == []


def described(old: str, new: str) -> Change:
    def change(capture: ForeignCapture) -> None:
        assert old in capture.description
        capture.description = capture.description.replace(old, new)

    return change


def every(change: Callable[[Pictures], NDArray[np.generic]]) -> Change:
    return lambda capture: capture.every(change)


def gamma(exponent: float) -> Change:
    return every(lambda p: np.rint(4095 * (np.maximum(p, 64) / 4095 - 64 / 4095) ** exponent).clip(0, 4031) + 64)


def frame(number: int, change: Callable[[ForeignCapture, Pictures], NDArray[np.generic]]) -> Change:
    def one(capture: ForeignCapture) -> None:
        capture.frames[number].picture = np.asarray(change(capture, capture.frames[number].picture), np.uint16)

    return one


def exchanged(capture: ForeignCapture) -> None:
    for low in range(0, len(capture.frames), 2):
        a, b = capture.frames[low : low + 2]
        a.picture, b.picture = b.picture, a.picture


def dark(kind: str) -> Change:
    """Nothing but noise in these images."""

    def change(capture: ForeignCapture) -> None:
        rng = np.random.default_rng(0)
        for frame in capture.frames:
            if frame.row["kind"] == kind:
                frame.picture = np.rint(rng.normal(64, 2.3, frame.picture.shape)).astype(np.uint16)

    return change


def angles(told: dict[float, float]) -> Change:
    return lambda capture: capture.rows(lambda row: {"angle_deg": told[float(str(row["angle_deg"]))]})


def stated_at(more: float) -> Change:
    def change(capture: ForeignCapture) -> None:
        described("[0.0, 40.0, 100.0]", str([a + more for a in (0.0, 40.0, 100.0)]))(capture)
        angles({a: a + more for a in (0.0, 40.0, 100.0)})(capture)

    return change


def two_stops(capture: ForeignCapture) -> None:
    for low in range(0, len(capture.frames), 2):
        light = capture.frames[low].picture - 64.0
        capture.frames[low + 1].picture = np.rint(64 + light.clip(-8) / 4 + (light < 9)).astype(np.uint16)


def backlit(capture: ForeignCapture) -> None:
    for frame in capture.frames:
        if frame.row["kind"] == "silhouette":
            white = 2400.0 * float(str(frame.row["exposure_s"])) / 0.02
            frame.picture = np.rint(64 + white - (frame.picture - 64.0)).astype(np.uint16)


def shifted_up(capture: ForeignCapture) -> None:
    described("bits = 12", "bits = 16")(capture)
    described("saturation_dn = 3900", "saturation_dn = 62400")(capture)
    capture.every(lambda picture: picture * 16)


def other_way(capture: ForeignCapture) -> None:
    described("[0.0, 40.0, 100.0]", "[0.0, -40.0, -100.0]")(capture)
    capture.rows(lambda row: {"angle_deg": -float(str(row["angle_deg"]))})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (every(lambda p: np.where(p > 64, p, 64) - 64), "sensor.offset_dn = 64.0: .* meet at -?[0-3] DN, 6. below it"),
        (described("offset_dn = 64.0", "offset_dn = 10.0"), "sensor.offset_dn = 10.0: .* meet at 6. DN, 5. above it"),
        (every(lambda p: np.minimum(p, 2000)), r"saturation_dn = 3900: \d+ pixels .* 2000 DN .* state 2000 or less"),
        (
            shifted_up,
            "sensor.bits = 16: no two numbers .* closer than 16.*divide the frames' numbers by 16",
        ),
        (exchanged, "lines 2 and 3 cannot be exposures .* as if the two were exchanged"),
        (two_stops, "lines 2 and 3 cannot .* steps of two stops"),
        (gamma(1 / 2.2), "gamma"),
        (gamma(1 / 1.25), "sensor.response: .* gamma of 1.[23].*switch the camera's gamma off"),
        (frame(4, lambda c, p: np.where(ROWS > 30, 0, p)), "0004.png: is no complete picture: .* row 31"),
        (
            frame(4, lambda c, p: np.where(ROWS > 40, c.frames[3].picture, p)),
            "is no complete picture: it ends with 7 rows of the frame before it .line 6",
        ),
        (frame(9, lambda c, p: c.frames[7].picture), "lines 9 and 11 show one picture"),
        (lambda c: c.rows(lambda r: {"power_w": r["power_w"] and 10.1}), "power_w = '10.1'.*1.01e.03 times.*to watts"),
        (every(lambda p: p[:, ::-1]), "likeliest cause: mirrored frames; overlaps with mirrored frames 0.9"),
        (every(lambda p: p[::-1]), "likeliest cause: upside-down frames"),
        (backlit, "likeliest cause: dark silhouettes"),
        (every(lambda p: p[::-1, ::-1]), "likeliest cause: frames turned by 180 deg"),
        (other_way, "likeliest cause: a turntable that turns the other way"),
        (lambda c: c.rows(lambda r: {"u": r["u"] and 4095 - r["u"]}), "likeliest cause: u counts the other way"),
        (lambda c: c.rows(lambda r: {"v": r["v"] and 4095 - r["v"]}), "likeliest cause: v counts the other way"),
        (lambda c: c.rows(lambda r: {"u": r["v"], "v": r["u"]}), "likeliest cause: u and v are exchanged"),
        (described("full_angle_deg = 5.0", "full_angle_deg = 2.5"), "full_angle_deg is half of what it should be .1"),
        (described("full_angle_deg = 5.0", "full_angle_deg = 10.0"), "full_angle_deg is twice what it should be .1"),
        (dark("spot"), "no spot shows any light beyond noise .33 were looked at"),
        (dark("silhouette"), "no silhouette shows any light beyond noise .3 were looked at"),
        (lambda c: c.scan.apply_scale(0.1), "likeliest cause: a scan in cm"),
        (lambda c: c.scan.apply_translation((0, 0, 20)), "overlap it by 0.0.*no simple slip explains them"),
        (described("[390.0, -120.0, 190.0]", "[0.39, -0.12, 0.19]"), "cameras.0..position_mm = .*inside the scan"),
        (described("[590.0, 60.0, 110.0]", "[0.59, 0.06, 0.11]"), "projector.position_mm = .*inside the scan"),
        (described("focal_length_mm = 62.0", "focal_length_mm = 0.062"), "overlap it by 0.00"),
        (angles({0.0: 40.0, 40.0: 100.0, 100.0: 0.0}), "cause: views in another order .0 is 2, 1 is 0, 2 is 1"),
        (stated_at(25.0), "likeliest cause: angles off by 335 deg"),
        (every(lambda p: np.repeat(p[::2], 2, 0)), "shows every row twice"),
        (every(lambda p: np.repeat(p[:, ::2], 2, 1)), "shows every column twice"),
        (every(lambda p: np.rint(64 + (p - 64.0) * (1 - (ROWS + COLUMNS) % 2 / 2))), "a colour camera's mosaic"),
    ],
)  # fmt: skip
def test_contradictions_are_refused_before_anything_is_stored(
    right: ForeignCapture, tmp_path: Path, change: Change, says: str
) -> None:
    capture = fresh(right)
    change(capture)
    folder = capture.write(tmp_path / "theirs")
    with pytest.raises(InputError, match=says) as caught:
        import_capture(folder, tmp_path / "x")
    assert "Remedy: " in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "x").exists()


def test_poses_that_do_not_fit_are_never_silent(
    right: ForeignCapture, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A capture that is there already, whose table is then said to turn the other way: a warning, also of a run."""
    capture = tmp_path / "x"
    plan = import_capture(right.write(tmp_path / "theirs"), capture)
    rig = (capture / "rig.json").read_text()
    assert "40.0" in rig and "100.0" in rig
    (capture / "rig.json").write_text(
        rig.replace(" 40.0", " -40.0").replace("[40.0", "[-40.0").replace("100.0", "-100.0")
    )
    steps: list[int] = []
    watch = watching(capture, plan, lambda done, total: steps.append(done))
    cause = "likeliest cause: a turntable that turns the other way"
    assert [cause in line for line in pose_warnings(capture)] == [True]
    with caplog.at_level(logging.WARNING):
        for done in range(1, len(plan) + 1):
            watch(done, len(plan))
    assert steps == list(range(1, len(plan) + 1))
    assert [cause in record.getMessage() for record in caplog.records] == [True]
    request = Request(format_version=1, reconstruct=ReconstructConfig(methods=("lambertian",)))
    assert cause in run(capture, tmp_path / "work", request)["warnings"][0]


# ---- the folder


def test_an_interrupted_import_goes_on(right: ForeignCapture, tmp_path: Path) -> None:
    folder = right.write(tmp_path / "theirs")
    import_capture(folder, tmp_path / "whole")

    def stop(done: int, total: int) -> None:
        if done > 0.7 * total:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_capture(folder, tmp_path / "parts", stop)
    with StreamReader(tmp_path / "parts") as stream:
        assert 0 < len(stream) < len(stream.plan)
    steps: list[int] = []
    import_capture(folder, tmp_path / "parts", lambda done, total: steps.append(done))
    assert len(steps) < len(right.frames) / 2
    for name in ("images.bin", "journal.bin", "plan.json", "rig.json", "import.json"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes()


def test_a_second_import_holds_the_corrected_frames(right: ForeignCapture, tmp_path: Path) -> None:
    first, second = fresh(right), fresh(right)
    first.frames[0].picture = np.roll(first.frames[0].picture, 1)
    import_capture(first.write(tmp_path / "first"), tmp_path / "x")
    import_capture(second.write(tmp_path / "second"), tmp_path / "x")
    import_capture(tmp_path / "second", tmp_path / "y")
    with StreamReader(tmp_path / "x") as found, StreamReader(tmp_path / "y") as wanted:
        assert all(np.array_equal(a.charge, b.charge) for a, b in zip(found, wanted, strict=True))  # type: ignore[union-attr]


@pytest.mark.parametrize("name", ["plan.json", "notes.txt", "images.bin"])
def test_what_an_import_did_not_write_stays(right: ForeignCapture, tmp_path: Path, name: str) -> None:
    folder, out = right.write(tmp_path / "theirs"), tmp_path / "x"
    out.mkdir()
    (out / name).write_text("mine")
    with pytest.raises(InputError, match=r"not empty and holds no import\. Remedy: choose another --out"):
        import_capture(folder, out)
    with pytest.raises(InputError, match="not empty and holds no import"):
        import_capture(folder, folder)
    assert (out / name).read_text() == "mine" and [path.name for path in out.iterdir()] == [name]


def test_what_was_changed_after_an_import_stays(right: ForeignCapture, tmp_path: Path) -> None:
    folder, out = right.write(tmp_path / "theirs"), tmp_path / "x"
    import_capture(folder, out)
    (out / "rig.json").write_text("mine")
    (out / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"rig\.json: was changed since it was imported"):
        import_capture(folder, out)
    assert (out / "rig.json").read_text() == "mine"


# ---- files of frames


def saved(path: Path, **options: object) -> Path:
    pictures = [Image.fromarray(np.full((4, 6), 64 + k, np.uint16)) for k in range(3)]
    if options.pop("stack", False):
        options |= {"save_all": True, "append_images": pictures[1:]}
    pictures[0].save(path, **options)  # type: ignore[arg-type]
    return path


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"stack": True}, "holds 3 pages .*one.*every page as a file of its own"),
        ({"tiffinfo": {274: 3}}, "Orientation = 3: is to be turned or mirrored"),
        ({"tiffinfo": {274: 6}}, "Orientation = 6"),
        ({"tiffinfo": {262: 0}}, "PhotometricInterpretation = 0: counts down from white"),
    ],
)
def test_files_that_are_not_one_picture_as_it_was_read(tmp_path: Path, options: dict[str, object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        read_frame(saved(tmp_path / "a.tif", **options), (4, 6), 4095, "line 2")
    assert read_frame(saved(tmp_path / "b.tif", tiffinfo={274: 1}), (4, 6), 4095, "line 2").max() == 64


def test_files_that_are_rescaled_as_they_are_read(tmp_path: Path) -> None:
    saved(tmp_path / "a.pgm")
    with pytest.raises(InputError, match="is of another format"):
        read_frame(tmp_path / "a.pgm", (4, 6), 4095, "line 2")


def test_numbers_with_their_bytes_exchanged(tmp_path: Path) -> None:
    picture = np.arange(24, dtype=np.uint16).reshape(4, 6) + 700
    Image.fromarray(picture.byteswap()).save(tmp_path / "a.png")
    with pytest.raises(InputError, match="exchange the two bytes of every number"):
        read_frame(tmp_path / "a.png", (4, 6), 4095, "line 2")
