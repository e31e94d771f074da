"""What a user can do wrong with a rig file, its ports and the options beside it: one line, with the remedy."""

from __future__ import annotations

import fcntl
import os
import re
import socket
from collections.abc import Callable
from pathlib import Path

import pytest
from test_capture_twin import RIG, Glow
from test_rig_cli import SCENE, quick
from test_rig_file import CAMERAS

from disco_twin.cli import main
from disco_twin.rig import TwinRig
from disco_twin.rig_commands import probe, rig_file_of, selftest
from disco_twin.rig_rules import load_rig_file
from disco_twin.rig_served import served
from hw.devices.genicam import CameraError
from hw.errors import InputError
from pipeline.rig import RigConfig

Says = Callable[..., str]


@pytest.fixture
def says(capsys: pytest.CaptureFixture[str]) -> Says:
    """The one line on stderr of a command that is refused, less its `disco-twin: `."""

    def refused(*words: object) -> str:
        with pytest.raises(SystemExit) as end:
            main([str(word) for word in words])
        said = capsys.readouterr().err
        assert end.value.code == 2 and said.count("\n") == 1 and len(said) < 700, said
        assert said.startswith("disco-twin: ") and ". Remedy: " in said, said
        return said.removeprefix("disco-twin: ").rstrip("\n")

    return refused


def rig_file(folder: Path, *changes: tuple[str, str], cameras: str | None = None, **ports: str) -> Path:
    content = rig_file_of(RIG, ports)
    if cameras is not None:
        content = content[: content.index("[[cameras]]")] + cameras
    for old, new in changes:
        assert old in content, old
        content = content.replace(old, new, 1)
    path = folder / "rig.toml"
    path.write_text(content, encoding="utf-8")
    return path


# ---- the file itself


def test_what_is_no_rig_file_says_so_and_where_one_is_shown(tmp_path: Path, says: Says) -> None:
    remedy = r".*Remedy: .*a rig file \(docs/lab.md, section 3, shows one; `disco-twin rig emulate` writes one\)"
    (tmp_path / "empty").write_text("\n# nothing\n")
    (tmp_path / "latin").write_bytes("format_version = 1 # für".encode("latin-1"))
    (tmp_path / "utf16").write_bytes("format_version = 1".encode("utf-16"))
    for name, problem in (
        ("none.toml", "no such file"),
        ("empty", "is empty"),
        ("latin", r"is not UTF-8 text \(byte 22\)"),
        ("utf16", r"is not UTF-8 text \(byte 0\)"),
        (".", "is a folder, not a file"),
        ("/dev/null", "is a device, not a file"),
    ):
        path = tmp_path / name
        assert re.fullmatch(f"{re.escape(str(path))}: {problem}{remedy}", says("rig", "probe", path))
    (tmp_path / "rig.toml").write_text("")
    assert says("rig", "probe", tmp_path / "rgi.toml").endswith(f"did you mean {tmp_path / 'rig.toml'}?")


def test_a_byte_order_mark_is_no_content(tmp_path: Path) -> None:
    """TOML 1.1: it is ignored. Windows' editors write one."""
    path = rig_file(tmp_path)
    plain = load_rig_file(path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert load_rig_file(path) == plain


# ---- its keys

FIRST = "format_version = 1"
TIME = "a number >= 0 and <= 3600"
WRONG = [
    ((FIRST, "format_version = true"), "format_version = true: is no choice here (allowed: 1). Remedy: write 1"),
    ((FIRST, "format_version = 1.0"), "format_version = 1.0: is no choice here (allowed: 1). Remedy: write 1"),
    ((FIRST, "format_version = 2"), "format_version = 2: is no choice here (allowed: 1). Remedy: write 1"),
    (("warm_up_s = 0.0", "warm_up_s = -1"), f"warm_up_s = -1: is out of range (allowed: {TIME}). Remedy: choose a "
     "value in that range, or leave the key out (it is 60.0 then)"),
    (("warm_up_s = 0.0", "warm_up_s = nan"), f"warm_up_s = nan: is no finite number (allowed: {TIME}). Remedy: write"),
    (("warm_up_s = 0.0", 'warm_up_s = "60"'), f"warm_up_s = '60': is no number (allowed: {TIME}). Remedy: write a "
     "number, without quotes"),
    (("warm_up_s = 0.0", "warm_up_s = 2000-01-01"), "warm_up_s = 2000-01-01: is no number (allowed"),
    (("warm_up_s = 0.0", "warm_up_s = 0x" + "f" * 5000), "warm_up_s = 0xffff"),
    (("warm_up_s = 0.0", "warm_up_s = " + "1" * 5000), "is not valid TOML: Exceeds the limit"),
    (("warm_up_s = 0.0", "warm_up_s = 0.0\nwarm_up_s = 1.0"), "is not valid TOML: Cannot overwrite a value (at line 3"),
    (("warm_up_s = 0.0", "wärm_up_s = 0.0"), "is not valid TOML: "),
    (("warm_up_s = 0.0", '"a\\nb" = 0.0'), '"a\\nb": unknown key. Remedy: use one of format_version, lasers'),
    (("gate_line = 0", "gate_line = 6"), "lasers[0].gate_line = 6: is out of range (allowed: a whole number >= 0 "),
    (("gate_line = 0", "gate_line = 0.0"), "lasers[0].gate_line = 0.0: is no whole number (allowed: a whole number >="),
    (("gate_line = 0", "baud = 9600\ngate_line = 0"), "lasers[0].baud = 9600: is no choice here (allowed: 57600, "
     "500000). Remedy: use one of 57600, 500000, or leave the key out (it is 500000 then)"),
    (("gate_line = 0", ""), "lasers[0].gate_line: required key is missing (allowed: a whole number >= 0 and <= 5). "
     "Remedy: add it: write a whole number"),
    (("[0.1, 1.5]", "[0.1]"), "lasers[0].photodiode_limits: has 1 values. Remedy: give one more"),
    (("[0.1, 1.5]", "0.1"), "lasers[0].photodiode_limits = 0.1: is no array (allowed: 2 values). Remedy: write an"),
    (("[turntable]", "[turntable]\ndirection = true"), "turntable.direction = true: is no choice here (allowed: 1, -"),
    (("[turntable]", "[turntable]\ndirection = 1.0"), "turntable.direction = 1.0: is no choice here (allowed: 1, -1)"),
    (("[turntable]", "[turntables]"), "turntables: unknown key. Remedy: did you mean 'turntable'?"),
    (('kind = "mm-ard"\nport = "emulated"', 'kind = "mm-ard"\nport = ""'), "board.port = '': is empty (allowed: a "),
    (('kind = "zaber"', "kind = [1]"), "turntable.kind = [1]: unknown kind (allowed: zaber, elliptec). Remedy: use"),
    (('name = "front"', 'name = "a\\u001bb"'), "cameras[0].name = 'a\\x1bb': is no such text (allowed: 1 to 64"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "said"), WRONG, ids=[said[:40] for _, said in WRONG])
def test_a_wrong_key_names_key_value_range_and_remedy(
    tmp_path: Path, says: Says, change: tuple[str, str], said: str
) -> None:
    path = rig_file(tmp_path, change)
    assert says("rig", "probe", path).startswith(f"{path}: {said}")


def test_tables_are_named_and_counted_not_shown(tmp_path: Path, says: Says) -> None:
    path = rig_file(tmp_path)
    content = path.read_text()
    begin, end = content.index("[[lasers]]"), content.index("[board]")
    for count in (2, 30):
        path.write_text(content[:begin] + count * content[begin:end] + content[end:])
        found = f"{path}: lasers: has {3 * count} tables (allowed: 1 to 3 tables). Remedy: give as many as are allowed"
        assert says("rig", "probe", path) == found
    path.write_text("lasers = []\n" + content[:begin] + content[end:])
    assert "lasers = []: has 0 values (allowed: 1 to 3 tables)" in says("rig", "probe", path)
    path.write_text(content[:begin] + content[end:])
    assert "lasers: required key is missing (allowed: 1 to 3 tables). Remedy: add it: write a table [[lasers]] for" in (
        says("rig", "probe", path)
    )
    path.write_text("sensor = 1\n" + content)
    assert "sensor = 1: is no table. Remedy: write a table [sensor] with its keys below it" in says(
        "rig", "probe", path
    )


@pytest.mark.parametrize("key", ["gain_e_per_dn", "read_noise_e", "responsivity"])
def test_a_sensor_beyond_all_floats_is_refused(tmp_path: Path, says: Says, key: str) -> None:
    path = rig_file(tmp_path, cameras=re.sub(rf"(?m)^{key} = .*", f"{key} = 1e308", CAMERAS))
    if key == "responsivity":
        path.write_text(path.read_text().replace("1e308", "[1e308, 1e12, 1e12]"))
    assert f"sensor.{key}" in says("rig", "probe", path)


# ---- units


@pytest.mark.parametrize(
    ("watts_per_count", "says_"),
    [
        ("1.955e-2", "the lower of photodiode_limits is 0.051 counts, and up to 8 are darkness"),  # in mW
        ("1.25e-4", "the lower of photodiode_limits is 8 counts"),
        ("1.955e-8", "the photodiode's converter ends below power_mw"),  # in kW
        ("1e308", "darkness"),
    ],
)
def test_watts_per_count_in_another_unit_is_refused(
    tmp_path: Path, says: Says, watts_per_count: str, says_: str
) -> None:
    path = rig_file(tmp_path, ("watts_per_count = ", f"watts_per_count = {watts_per_count} #"))
    said = says("rig", "probe", path)
    assert f"lasers[0].watts_per_count = {float(watts_per_count)!r}: " in said and says_ in said
    assert "(allowed: at least 9.775e-06, below 0.000125)" in said


def test_power_in_another_unit_is_refused_by_what_the_laser_says_of_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The laser's maximum is 10 mW. Expected: 0.01 (W) and 400 (no unit at all) refused with figures, by probe and by
    the self-test, before anything is armed; other lasers are asked all the same.
    """
    monkeypatch.setattr("hw.devices.mm_ard.BOOT_S", 0.05)
    with served(RIG, 3, tmp_path / "ports") as path:
        content = path.read_text()
        for power, remedy in (
            ("0.01", "give the power in mW (10, if this is in W)"),
            ("400.0", "give the power in mW"),
        ):
            watts = 1e-3 * float(power) / 500
            changed = content.replace("power_mw = 10.0", f"power_mw = {power}", 1)
            path.write_text(re.sub(r"watts_per_count = \S+", f"watts_per_count = {watts}", changed, count=1))
            for run in (probe(load_rig_file(path), None), selftest(load_rig_file(path), None, armed=True)):
                found = [next(run), next(run)]
                assert [f.good for f in found] == [False, True]
                assert f"{path}: lasers[0].power_mw = {power}: laser 635 nm (LuxX) says that its max" in found[0].text
                assert found[0].text.endswith(f"(allowed: more than 0.1, at most 10). Remedy: {remedy}")
                run.close()


def test_the_self_test_compares_photodiode_own_reading_and_meter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """watts_per_count twice what it is for the first laser. Expected: refused with the counts and the value that the
    laser's own reading asks for; for the others the value that the power meter asks for.
    """
    quick(monkeypatch)
    monkeypatch.setattr("disco_twin.rig_commands._metered", lambda connect: 0.0095)
    with served(RIG, 3, tmp_path / "ports") as path:
        content = path.read_text()
        right = float(re.findall(r"watts_per_count = (\S+)", content)[0])
        content = content.replace(f"watts_per_count = {right!r}", f"watts_per_count = {2 * right!r}", 1)
        path.write_text(content + '[power_meter]\nkind = "ophir"\nport = "emulated"\n')
        found = {f.name: f.text for f in selftest(load_rig_file(path), None, armed=True)}
    first, second = found["laser 635 nm"], found["laser 532 nm"]
    said = re.search(r"gives 20.0\d mW \((\d+) counts\).*\(allowed: 1 to 15 mW\)", first)
    assert said and 1e-5 < right < 2.5e-5
    assert re.search(rf"Remedy: .*is near {0.01 / int(said[1]):.3g} by the laser's own reading", first)
    assert re.search(
        r"photodiode 10.0\d mW \((\d+) counts\), power meter 9.50 mW: watts_per_count = 1.\d+e-05;", second
    )


# ---- ports


def test_ports_that_cannot_be_opened_name_key_and_remedy(tmp_path: Path) -> None:
    """Laser 1's port is opened by its guard process, the turntable's by the program itself."""
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
    "port", ["hwgrep://(", "loop://", "socket://", "rfc2217://x", "guard:///dev/x", "nonsense://x"]
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

    monkeypatch.setattr("hw.devices.viva.VivaGrabber", grabber)
    path = rig_file(tmp_path, cameras=CAMERAS)
    first, second = probe(load_rig_file(path), RIG)
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
    good = rig_file_of(RigConfig(cameras=(RIG.cameras[0],)), {})
    monkeypatch.setattr("disco_twin.simulate.twin_rig", lambda world, folder: TwinRig(world.scene.rig, Glow(), 5))
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
    one = RigConfig(cameras=(RIG.cameras[0],))
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
        (["rig", "probe"], "Missing argument 'RIG.TOML'. Remedy: `disco-twin rig probe --help` says what is allowed"),
        (["rig", "probe", "a", "b"], "Got unexpected extra argument"),
        (["rig", "selftest", "a", "--armed"], "No such option: --armed"),
        (["rig", "emulate", "a", "--ports", "b", "--seconds", "x"], "Invalid value for '--seconds'"),
        (["capture", "a"], "Missing option '--out'. Remedy: `disco-twin capture --help` says what is allowed"),
    ],
)
def test_a_wrong_command_is_one_line(says: Says, words: list[str], said: str) -> None:
    assert says(*words).startswith(said)


def test_the_file_that_an_error_names_is_the_one_that_was_given(tmp_path: Path) -> None:
    """Twice named would be wrong where one error passes several places that know a file."""
    path = rig_file(tmp_path, (FIRST, "format_version = 3"))
    with pytest.raises(InputError) as caught:
        load_rig_file(path)
    assert str(caught.value).count("rig.toml") == 1
