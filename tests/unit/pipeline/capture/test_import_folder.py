"""Captures made without our software: frames on disk become the exact record; what cannot be is refused in one line."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image

from disco_twin.cli.app import main
from hw.base.config import read_json
from hw.base.errors import InputError
from hw.camera.bracket import Bracket
from pipeline.capture.import_folder import COLUMNS, import_capture
from pipeline.capture.quality import examine
from pipeline.geometry.mesh_file import read_scan
from pipeline.records import NominalRigFile, SensorFile
from pipeline.stream.stream import StreamReader

HEIGHT, WIDTH = 31, 48
LONGEST, STEPS, FULL = 0.02, 4, 4000
LASERS = (635.0, 532.0)
ANGLES = (0.0, 120.0)
SPOTS = {0: ((1000, 1200), (1400, 1300)), 1: ((2000, 2100),)}
CAMERAS = ("front", "back")

DESCRIPTION = f"""
format_version = 1
scan = "scan.obj"
saturation_dn = {FULL}

[sensor]
longest_exposure_s = {LONGEST}
steps = {STEPS}
bits = 12
gain_e_per_dn = 8.0
read_noise_e = 5.0
dark_e_per_s = 0.0
offset_dn = 64.0
responsivity = [1e12, 2e12]

[rig]
turntable_angles_deg = [0.0, 120.0]
spots = 3
lasers = [{{wavelength_nm = 635}}, {{wavelength_nm = 532}}]
cameras = [
  {{name = "front", position_mm = [450, 60, 100], width = {WIDTH}, height = {HEIGHT}}},
  {{name = "back", position_mm = [-450, 60, 100], width = {WIDTH}, height = {HEIGHT}}},
]
"""


def rate(camera: int, angle: int, u: int, laser: int) -> NDArray[np.float64]:
    """(H, W) digital numbers per second: three decades across the image."""
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    distance = np.hypot(row - 15, column - 20 - u / 500)
    return np.asarray(10.0 ** (6.2 - distance / 9) * (1 + 0.1 * camera + 0.2 * angle + 0.3 * max(laser, 0)))


def pixels(exposed: NDArray[np.float64], seconds: float) -> NDArray[np.uint16]:
    return np.minimum(64 + exposed * seconds, 4095).astype(np.uint16)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A capture as another laboratory might hand it over: PNG and TIFF, lines in no order."""
    source = tmp_path / "theirs"
    (source / "frames").mkdir(parents=True)
    (source / "capture.toml").write_text(DESCRIPTION)
    trimesh.creation.icosphere(subdivisions=1, radius=20).export(source / "scan.obj")
    rows: list[tuple[object, ...]] = []
    for camera, name in enumerate(CAMERAS):
        for angle, degrees in enumerate(ANGLES):
            images = [("silhouette", -1, -1, -1)]
            images += [("spot", u, v, laser) for u, v in SPOTS[angle] for laser in range(len(LASERS))]
            for kind, u, v, laser in images:
                for k in range(STEPS):
                    file = f"frames/{name}-{angle}-{u}-{laser}-{k}.{'png' if k % 2 else 'tif'}"
                    seconds = LONGEST / 2**k
                    Image.fromarray(pixels(rate(camera, angle, u, laser), seconds)).save(source / file)
                    place = (
                        ("", "", "", seconds, "")
                        if laser < 0
                        else (u, v, LASERS[laser], seconds, round(0.01 + 0.001 * k, 6))
                    )
                    rows.append((file, kind, name, degrees, *place, len(rows) * 0.1))
    write(source, rows)
    return source


def write(source: Path, rows: list[tuple[object, ...]]) -> None:
    order = np.random.default_rng(1).permutation(len(rows))
    with (source / "images.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        table.writerows(rows[i] for i in order)


def test_every_image_is_the_record_of_its_bracket(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "ours"
    plan = import_capture(folder, out)
    assert len(plan) == 2 * (1 + 4 + 1 + 2)
    bracket = Bracket(LONGEST, tuple(range(STEPS)), 12, FULL)
    with StreamReader(out) as stream:
        stream.require_complete()
        for address in plan.addresses():
            aim = plan.spots[address.spot] if address.kind == "spot" else None
            exposed = rate(
                plan.camera_of(address.view), plan.angle_of(address.view), aim.u if aim else -1, address.laser
            )
            exact = bracket.merge((k, pixels(exposed, LONGEST / 2**k)) for k in range(STEPS))
            found, meta = stream.read(address), stream.meta(address)
            assert np.array_equal(found.charge, exact.charge) and np.array_equal(found.exponent, exact.exponent)
            assert set(np.unique(exact.exponent)) == {0, 1, 2, 3}
            if aim:
                weights = 0.5 ** np.arange(STEPS)
                assert meta.photodiode_w == pytest.approx(np.average(0.01 + 0.001 * np.arange(4), weights=weights))
                assert (meta.u, meta.v) == (aim.u, aim.v)
        qualities = list(examine(stream, read_json(out / "sensor.json", SensorFile, "").sensor))
    assert read_json(out / "rig.json", NominalRigFile, "").rig.cameras[1].name == "back"
    assert [(q.stored, q.planned, q.spots, q.dark, q.damaged) for q in qualities] == [
        (5, 5, 2, 0, 0),
        (3, 3, 1, 0, 0),
    ] * 2
    assert all(q.saturated > 0.001 and q.remarks == ["saturated: a shorter exposure or less light"] for q in qualities)


def test_an_import_that_was_interrupted_goes_on(folder: Path, tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    import_capture(folder, whole)
    frame = folder / "frames" / "back-0-1000-1-0.tif"
    kept = frame.read_bytes()
    frame.unlink()
    with pytest.raises(InputError, match="no such file"):
        import_capture(folder, parts)
    frame.write_bytes(kept)
    import_capture(folder, parts)
    assert (whole / "images.bin").read_bytes() == (parts / "images.bin").read_bytes()


def replace(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return change


def drop(text: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        lines = (folder / "images.csv").read_text().splitlines()
        (folder / "images.csv").write_text("\n".join(line for line in lines if text not in line))

    return change


def picture(array: NDArray[np.generic], name: str = "frames/front-0--1--1-0.tif") -> Callable[[Path], None]:
    return lambda folder: Image.fromarray(array).save(folder / name)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            drop("front-0-1000-1-"),
            "1 of 16 images are missing, the first is camera front, 0 deg, u 1000, v 1200, 532 nm",
        ),
        (drop("back-1--1-"), "the first is camera back, 120 deg, silhouette"),
        (replace("images.csv", "exposure_s", "exposure"), "has no column 'exposure_s'"),
        (replace("images.csv", ",0.005,", ",0.0052,"), r"exposure_s = '0.0052'.*0.02 s / 2\^k, k = 0 to 3"),
        (replace("images.csv", ",120.0,", ",119.0,"), "angle_deg = '119.0'.*0, 120"),
        (replace("images.csv", "532.0", "561"), "laser_nm = '561'.*635, 532"),
        (replace("images.csv", ",2000,2100,", ",2000.5,2100,"), "u = '2000.5'.*whole steps"),
        (replace("images.csv", ",2000,2100,", ",2000,9999,"), "v = '9999'.*0 to 4095"),
        (replace("images.csv", "0.013,", "0,"), "power_w = '0'.*more than 0"),
        (replace("images.csv", "spot,front", "spot,left"), "camera = 'left'.*front, back"),
        (replace("images.csv", "spot,", "dot,"), "kind = 'dot'.*silhouette, spot"),
        (replace("capture.toml", "scan.obj", "scan.ply"), "scan.*no such file"),
        (replace("capture.toml", "bits = 12", "bits = 11"), "saturation_dn = 4000 is beyond .*at most 2047"),
        (replace("capture.toml", "bits = 12", "bits = 17"), "sensor.bits = 17.*<= 16"),
        (
            replace("capture.toml", "[1e12, 2e12]", "[1e12]"),
            "sensor.responsivity has 1 of the 2 values",
        ),
        (replace("capture.toml", "[1e12, 2e12]", "[1e12, -2e12]"), r"sensor.responsivity\[1\] = -2000000000000.*>= 1"),
        (replace("capture.toml", "[1e12, 2e12]", "[1e12, 2e18]"), r"sensor.responsivity\[1\] = 2e.18.*<= 1e.18"),
        (replace("capture.toml", "gain_e_per_dn = 8.0", "gain_e_per_dn = 0.0"), "sensor.gain_e_per_dn = 0.*>= 1e-06"),
        (replace("capture.toml", "offset_dn = 64.0", "offset_dn = 4001.0"), "sensor.offset_dn = 4001 is no less than"),
        (replace("capture.toml", "steps = 4", "steps = 0"), "sensor.steps = 0"),
        (replace("capture.toml", "steps = 4", 'steps = "4"'), "sensor.steps = '4'"),
        (replace("capture.toml", "bits = 12", "bits = 7"), "sensor.bits = 7.*>= 8 and <= 16"),
        (replace("capture.toml", "read_noise_e = 5.0", "read_noise_e = -6.0"), "sensor.read_noise_e = -6.0.*>= 0"),
        (replace("capture.toml", "dark_e_per_s = 0.0", "dark_e_per_s = 1e10"), "sensor.dark_e_per_s = 1.*<= 1"),
        (replace("capture.toml", f"longest_exposure_s = {LONGEST}", "longest_exposure_s = 20.0"), "= 20.0.*<= 10"),
        (replace("capture.toml", f"saturation_dn = {FULL}", "saturation_dn = 30"), "nothing is left for light"),
        (replace("capture.toml", "responsivity = ", "response = [0.0, 0.7]\nresponsivity = "), "rise from 0 to 1"),
        (replace("images.csv", "frames/", "frames\\"), r"file = 'frames.*separated by /"),
        (
            replace("images.csv", "front-0-1000-0-1.png", "front-0-1000-0-0.tif"),
            r"lines \d+ and \d+ name the same file",
        ),
        (picture(np.zeros((HEIGHT, WIDTH), np.uint8)), "is not 16-bit grey"),
        (picture(np.zeros((HEIGHT, WIDTH + 1), np.uint16)), f"has {WIDTH + 1} x {HEIGHT} pixels.*{WIDTH} x {HEIGHT}"),
        (picture(np.full((HEIGHT, WIDTH), 4096, np.uint16)), "beyond the sensor's.*0 to 4095.*upper bits"),
        (lambda folder: (folder / "frames/front-0--1--1-0.tif").write_bytes(b"II*\0junk"), "not a readable image"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    folder: Path, tmp_path: Path, change: Callable[[Path], None], says: str
) -> None:
    change(folder)
    with pytest.raises(InputError, match=says) as caught:
        import_capture(folder, tmp_path / "ours")
    assert ("\n" not in str(caught.value) and str(folder) in str(caught.value)) or "saturation_dn" in str(caught.value)


def scan(change: Callable[[trimesh.Trimesh], None], suffix: str = "ply") -> Callable[[Path], None]:
    def write_scan(folder: Path) -> None:
        ball = trimesh.creation.icosphere(subdivisions=1, radius=20)
        change(ball)
        ball.export(folder / f"scan.{suffix}")
        replace("capture.toml", "scan.obj", f"scan.{suffix}")(folder)

    return write_scan


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (scan(lambda m: m.apply_scale(1e-3)), "0.04 mm large.*scale it by 1000 if it is in metres"),
        (scan(lambda m: m.invert()), "inside out.*`disco-twin mesh .*scan.ply .*scan-closed.ply`"),
        (scan(lambda m: m.update_faces(np.arange(80) > 0), "stl"), "3 of 120 edges.*`disco-twin mesh .*scan.stl"),
        (lambda folder: (folder / "scan.obj").write_bytes(b"II*\0junk"), "scan.obj: the mesh is empty"),
    ],
)
def test_a_scan_that_cannot_be_used_is_refused_before_any_frame_is_read(
    folder: Path, tmp_path: Path, change: Callable[[Path], None], says: str
) -> None:
    change(folder)
    with pytest.raises(InputError, match=says):
        import_capture(folder, tmp_path / "ours")
    assert not (tmp_path / "ours").exists()


def test_a_scan_as_stl(folder: Path, tmp_path: Path) -> None:
    scan(lambda m: None, "stl")(folder)
    import_capture(folder, tmp_path / "ours")
    mesh = read_scan(tmp_path / "ours" / "scan.ply")
    assert len(mesh.vertices) == 42 and mesh.volume == pytest.approx(trimesh.creation.icosphere(1, 20).volume, rel=1e-6)


def test_duplicate_frames_are_refused(folder: Path, tmp_path: Path) -> None:
    text = (folder / "images.csv").read_text()
    first = text.splitlines()[1]
    (folder / "images.csv").write_text(text + "frames/again.png" + first[first.index(",") :] + "\n")
    with pytest.raises(InputError, match=r"lines 2 and \d+ are the same image with the same exposure"):
        import_capture(folder, tmp_path / "ours")


def copy(source: str, target: str) -> Callable[[Path], None]:
    return lambda folder: (folder / "frames" / target).write_bytes((folder / "frames" / source).read_bytes())


@pytest.mark.parametrize(
    "change",
    [
        copy("front-0-1000-0-0.tif", "front-0-1000-0-1.png"),  # the same exposure under two names
        copy("front-0-1000-0-2.tif", "front-0-1000-0-1.png"),
        copy("front-0--1--1-3.png", "front-0-1000-0-1.png"),  # an image of something else
    ],
)
def test_frames_that_contradict_their_exposures_are_refused(
    folder: Path, tmp_path: Path, change: Callable[[Path], None]
) -> None:
    """A longer exposure has as much more light as it is longer: frames that do not are not of one image."""
    change(folder)
    with pytest.raises(InputError, match=r"images.csv: exposure_s: lines \d+ and \d+ cannot be exposures of one image"):
        import_capture(folder, tmp_path / "ours")


def test_power_that_differs_within_a_bracket_is_no_contradiction(folder: Path, tmp_path: Path) -> None:
    """Rationale: one frame of about twice the power, and of the light."""
    exposed = rate(0, 0, 1000, 0)
    Image.fromarray(pixels(2.1 * exposed, LONGEST / 2)).save(folder / "frames" / "front-0-1000-0-1.png")
    lines = (folder / "images.csv").read_text().splitlines()
    doubled = [line.replace("0.011,", "0.02,") if "front-0-1000-0-1." in line else line for line in lines]
    assert doubled != lines
    (folder / "images.csv").write_text("\n".join(doubled))
    import_capture(folder, tmp_path / "ours")


def test_the_commands(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "ours"
    for command in (["import", str(folder), "--out", str(out)], ["quality", str(out)]):
        with pytest.raises(SystemExit) as end:
            main(command)
        assert end.value.code == 0
    said = capsys.readouterr().out
    assert "16 images, 4 views, 3 spots" in said
    assert "5/5" in said and "10.73 10.73" in said
