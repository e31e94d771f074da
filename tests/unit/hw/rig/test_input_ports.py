"""What a user can do wrong with a rig's ports, cameras and captures: one line, with the remedy."""

from __future__ import annotations

import fcntl
import os
import re
import socket
from pathlib import Path

import pytest
from refusals import Says
from rig_fakes import SCENE
from rig_files import CAMERAS, rig_file
from twin_fakes import RIG, Glow

from disco_twin.cli.app import main
from disco_twin.emulation.rig_file_of import rig_file_of
from disco_twin.emulation.served_rig import served
from disco_twin.emulation.twin_rig import TwinRig
from disco_twin.scene.rig_schema import TwinRigConfig
from hw.base.errors import InputError
from hw.camera.genicam import CameraError
from hw.rig.rig_rules import load_rig_file
from hw.rig.selftest import probe


def test_ports_that_cannot_be_opened_name_key_and_remedy(tmp_path: Path) -> None:
    """Laser 1's port is opened by the supervisor, the turntable's by the program itself."""
    master, slave = os.openpty()
    held = os.open(os.ttyname(slave), os.O_RDWR)
    fcntl.flock(held, fcntl.LOCK_EX)  # as another program's pyserial does
    (tmp_path / "file").write_text("kept")
    nobody = socket.create_server(("127.0.0.1", 0))
    url = f"socket://127.0.0.1:{nobody.getsockname()[1]}"
    nobody.close()
    try:
        for port, problem, remedy in (
            (
                str(tmp_path / "none"),
                "there is no such device",
                "plug it in, switch it on and correct the port: `ls -l",
            ),
            (str(tmp_path / "file"), "it is no serial port", "name the device's port"),
            (str(tmp_path), "it is no serial port", "name the device's port"),
            ("/dev/null", "it is no serial port", "name the device's port"),
            (os.ttyname(slave), "another program uses it", "end that program"),
            (url, "nobody answers there", "start the program"),
        ):
            for name, key, device in (
                ("laser1", "lasers[1].port", "laser 532 nm"),
                ("turntable", "turntable.port", "turntable"),
            ):
                path = rig_file(tmp_path, **{name: port})
                (found,) = probe(load_rig_file(path), None)
                said = f"{path}: {key} = '{port}': the port of {device} cannot be opened: {problem}. Remedy: {remedy}"
                assert not found.good and found.text.startswith(said) and "\n" not in found.text, found
    finally:
        for handle in (held, slave, master):
            os.close(handle)
    assert (tmp_path / "file").read_text() == "kept"


def test_a_port_that_is_not_ours_to_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: object, **__: object) -> None:
        raise OSError("[Errno 13] could not open port /dev/x: [Errno 13] Permission denied: '/dev/x'")

    monkeypatch.setattr("serial.serial_for_url", forbidden)
    (found,) = probe(load_rig_file(rig_file(tmp_path, board="/dev/x")), None)
    assert "board.port = '/dev/x': the port of mirror board cannot be opened: permission denied. Remedy: join the" in (
        found.text
    )


def test_a_wrong_device_names_the_key_of_its_port(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hw.devices.mm_ard.BOOT_S", 0.05)
    with served(RIG, 3, tmp_path / "ports") as served_file:
        path = rig_file(tmp_path, board=str(served_file.parent / "turntable"))
        (found,) = probe(load_rig_file(path), None)
    assert (
        found.text.startswith(f"{path}: board.port = '{served_file.parent / 'turntable'}': ") and "Remedy" in found.text
    )


def test_one_device_under_two_names_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, says: Says) -> None:
    """A relative path, a chain of links, a link to a folder; a device that is plugged in and one that is not."""
    master, slave = os.openpty()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "by-id").symlink_to("folder")
    try:
        for device in (os.ttyname(slave), str(tmp_path / "not" / "there")):
            (tmp_path / "folder" / "one").unlink(missing_ok=True)
            (tmp_path / "folder" / "one").symlink_to(device)
            for other in (
                "by-id/one",
                "./folder/../by-id/one",
                str(tmp_path / "by-id" / "one"),
                os.path.relpath(device),
            ):
                path = rig_file(tmp_path, laser0=device, board=other)
                said = (
                    f"{path}: board.port = '{other}': is the port of lasers[0].port as well (allowed: one device a po"
                )
                assert says("rig", "probe", path).startswith(said)
    finally:
        os.close(slave)
        os.close(master)


@pytest.mark.parametrize(
    "port", ["hwgrep://(", "loop://", "socket://", "rfc2217://x", "supervised://laser:/dev/x", "nonsense://x"]
)
def test_other_ports_than_paths_and_sockets_are_refused(tmp_path: Path, says: Says, port: str) -> None:
    path = rig_file(tmp_path, turntable=port)
    assert says("rig", "probe", path).startswith(
        f"{path}: turntable.port = '{port}': is no port (allowed: a path, or socket://HOST:PORT). Remedy: name"
    )


# ---- cameras


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            CameraError("camera 10.0.0.8 does not answer. Remedy: check power"),
            "address = '10.0.0.8': camera 10.0.0.8 does",
        ),
        (
            InputError("is another one", key="serial", value="A", allowed="B", remedy="correct it"),
            "serial = 'A': is ano",
        ),
    ],
)
def test_a_camera_that_cannot_be_opened_names_its_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, said: str
) -> None:
    def grabber(address: str, *_: object, **__: object) -> None:
        if address == "10.0.0.8":
            raise error
        raise InputError("the camera needs the package viva-genicam", remedy="pip install 'disco-twin[genicam]'")

    monkeypatch.setattr("hw.camera.viva_grabber.VivaGrabber", grabber)
    path = rig_file(tmp_path, cameras=CAMERAS)
    first, second = probe(load_rig_file(path), {"front": (31, 48), "back": (31, 48)})
    assert first.text.startswith(f"{path}: the camera needs the package") and "Remedy: pip" in first.text
    assert second.text.startswith(f"{path}: cameras[1].{said}") and "Remedy: " in second.text


# ---- a capture


def test_a_capture_names_the_rig_file_s_keys_and_its_own_copy(
    tmp_path: Path, says: Says, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A port that is not there, mirror limits that the plan leaves, a damaged copy: none is the scene's fault.

    Expected: before the first image; after each the capture goes on once the file is right.
    """
    scene, rig, out = tmp_path / "scene.toml", tmp_path / "rig.toml", tmp_path / "out"
    scene.write_text(SCENE)
    good = rig_file_of(TwinRigConfig(cameras=(RIG.cameras[0],)), {})
    monkeypatch.setattr("disco_twin.run.simulate.twin_rig", lambda x, _: TwinRig(x.scene.rig, Glow(), 5))
    command = ("capture", scene, "--out", out, "--rig", rig)
    rig.write_text(good.replace('kind = "mm-ard"\nport = "emulated"', 'kind = "mm-ard"\nport = "/dev/none"'))
    assert says(*command).startswith(
        f"{rig}: board.port = '/dev/none': the port of mirror board cannot be opened: there"
    )
    rig.write_text(good.replace("floodlight_line", "limits_u = [2040, 2060]\nfloodlight_line"))
    said = says(*command)
    assert re.match(
        rf"{rig}: board.limits_u = \[2040, 2060\]: \d of the scene's 6 spots lie outside \(allowed: at", said
    )
    rig.write_text(good)
    with pytest.raises(SystemExit) as end:
        main([str(word) for word in command])
    assert end.value.code == 0
    record = out / "capture" / "devices.toml"
    kept = record.read_bytes()
    for damaged in (b"", b"format_version = 9\n", kept[: len(kept) // 2]):
        record.write_bytes(damaged)
        said = says(*command)
        assert said.startswith(f"{record}: ") and "the capture's own copy of its rig file cannot be used" in said
        assert "Remedy: put the rig file there that the capture was begun with, or choose another --out" in said
    record.write_bytes(kept)
    with pytest.raises(SystemExit) as end:
        main([str(word) for word in command])
    assert end.value.code == 0


# ---- the options


def test_a_folder_for_logs_that_cannot_be(tmp_path: Path, says: Says, monkeypatch: pytest.MonkeyPatch) -> None:
    """Refused before any device is connected and before the scan is made. Expected: the file is as it was."""
    kept = tmp_path / "notes.txt"
    kept.write_text("kept")
    one = TwinRigConfig(cameras=(RIG.cameras[0],))
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "one.toml").write_text(rig_file_of(one, {"turntable": str(tmp_path / "none")}))
    capture = ("capture", tmp_path / "scene.toml", "--out", tmp_path / "out", "--rig", tmp_path / "one.toml")
    for command in (("rig", "probe", rig_file(tmp_path)), ("rig", "selftest", rig_file(tmp_path)), capture):
        for logs in (kept, kept / "inside"):
            said = f"{logs}: --logs: a file is in its place. Remedy: choose another --logs"
            assert says(*command, "--logs", logs) == said
    assert not (tmp_path / "out" / "capture" / "scan.ply").exists()

    def read_only(self: Path, **_: object) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "mkdir", read_only)
    said = says("rig", "probe", rig_file(tmp_path), "--logs", tmp_path / "new")
    assert (
        said == f"{tmp_path / 'new'}: --logs: cannot be written to (permission denied). Remedy: choose another --logs"
    )
    assert kept.read_text() == "kept"


def test_options_for_devices_need_devices(tmp_path: Path, says: Says) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    for words in (["--arm"], ["--logs", "x"]):
        said = says("capture", tmp_path / "scene.toml", "--out", tmp_path / "out", *words)
        assert said.startswith(f"{words[0]}: is for devices. Remedy: name their rig file with --rig")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("seconds", ["nan", "inf", "-1", "1e308", "0"])
def test_devices_are_emulated_for_a_time_that_can_be(tmp_path: Path, says: Says, seconds: str) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    said = says("rig", "emulate", tmp_path / "scene.toml", "--ports", tmp_path / "p", "--seconds", seconds)
    assert said.startswith(f"--seconds = {float(seconds)!r}: ") and "allowed: 0.1 to 10000000" in said


def test_emulated_devices_take_nobodys_place(tmp_path: Path, says: Says) -> None:
    """A rig file or a file with a port's name is not overwritten; a rig file that would be the same one is."""
    scene, ports = tmp_path / "scene.toml", tmp_path / "ports"
    scene.write_text(SCENE)
    command = ("rig", "emulate", scene, "--ports", ports, "--seconds", "0.1")
    for _ in range(2):
        with pytest.raises(SystemExit) as end:
            main([str(word) for word in command])
        assert end.value.code == 0
    mine = ports / "rig.toml"
    mine.write_text("# measured for weeks\n" + mine.read_text())
    assert says(*command).startswith(
        f"{mine}: is another rig file than the one to be written. Remedy: choose another --"
    )
    assert mine.read_text().startswith("# measured for weeks")
    (ports / "board").write_text("kept")
    assert says(*command).startswith(f"{ports / 'board'}: is in the place of an emulated device's port. Remedy: ")
    assert (ports / "board").read_text() == "kept"
    assert says(*command[:4], scene).startswith(f"{scene}: --ports: a file is in its place")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["rig"], "Missing command. Remedy: `disco-twin rig --help`"),
        (["rig", "prob"], "No such command 'prob'"),
        (["rig", "probe"], "Missing argument 'RIG.TOML'. Remedy: `disco-twin rig probe --help` lists what is allowed"),
        (["rig", "probe", "a", "b"], "Got unexpected extra argument"),
        (["rig", "selftest", "a", "--armed"], "No such option: --armed"),
        (["rig", "emulate", "a", "--ports", "b", "--seconds", "x"], "Invalid value for '--seconds'"),
        (["capture", "a"], "Missing option '--out'. Remedy: `disco-twin capture --help` lists what is allowed"),
    ],
)
def test_a_wrong_command_is_one_line(says: Says, words: list[str], said: str) -> None:
    assert says(*words).startswith(said)


def test_the_file_that_an_error_names_is_the_one_that_was_given(tmp_path: Path) -> None:
    """Twice named would be wrong where one error passes several places that know a file."""
    path = rig_file(tmp_path, ("format_version = 1", "format_version = 3"))
    with pytest.raises(InputError) as caught:
        load_rig_file(path)
    assert str(caught.value).count("rig.toml") == 1


def test_a_scene_given_as_the_rig_file_and_a_rig_file_as_the_scene_are_called_that(tmp_path: Path, says: Says) -> None:
    scene, rig = tmp_path / "scene.toml", tmp_path / "rig.toml"
    scene.write_text(SCENE)
    rig.write_text(rig_file_of(RIG, {}))
    assert says("rig", "probe", scene).startswith(f"{scene}: is a scene. Remedy: give the path of a rig file (docs/lab")
    remedy = "Remedy: give the path of a scene's TOML file"
    assert says("rig", "emulate", rig, "--ports", tmp_path / "ports") == f"{rig}: is a rig file. {remedy}"
    assert says("capture", rig, "--out", tmp_path / "out", "--rig", scene) == f"{rig}: is a rig file. {remedy}"
