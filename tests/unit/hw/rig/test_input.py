"""What a user can do wrong in a rig file: one line, with the remedy."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from refusals import Says
from rig_fakes import quick
from rig_files import CAMERAS, rig_file
from twin_fakes import RIG

from disco_twin.emulation.served_rig import served
from hw.rig.rig_rules import load_rig_file
from hw.rig.selftest import probe, selftest

# ---- the file itself


def test_what_is_no_rig_file_says_so_and_where_one_is_shown(tmp_path: Path, says: Says) -> None:
    remedy = r".*Remedy: .*a rig file \(docs/lab.md, section 3, shows one; `disco-twin rig emulate` writes one\)"
    (tmp_path / "empty").write_text("\n# nothing\n")
    (tmp_path / "latin").write_bytes("format_version = 1 # für".encode("latin-1"))
    (tmp_path / "utf16").write_bytes("format_version = 1".encode("utf-16"))
    os.mkfifo(tmp_path / "pipe")  # nobody writes into it: it would be waited for
    for name, problem in (
        ("none.toml", "no such file"),
        ("empty", "is empty"),
        ("latin", r"is not UTF-8 text \(byte 22\)"),
        ("utf16", r"is not UTF-8 text \(byte 0\)"),
        (".", "is a folder, not a file"),
        ("/dev/null", "is a device or a pipe, not a file"),
        ("pipe", "is a device or a pipe, not a file"),
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
    assert "lasers[0].power_mw = 10.0: " in said and says_ in said
    assert f"lasers[0].watts_per_count = {float(watts_per_count):.4g}" in said
    assert "(allowed: with this power, watts_per_count at least 9.775e-06, below 0.000125)" in said


def test_a_power_in_watts_is_not_blamed_on_the_measured_constant(tmp_path: Path, says: Says) -> None:
    """One of the two is in another unit, and the file alone does not say which."""
    path = rig_file(tmp_path, ("power_mw = 10.0", "power_mw = 0.01"))
    said = says("rig", "probe", path)
    assert said.startswith(f"{path}: lasers[0].power_mw = 0.01: does not go with lasers[0].watts_per_count = 1.955"), (
        said
    )
    assert "one of the two is in another unit" in said and "power_mw in mW" in said


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
                assert f"{path}: lasers[0].power_mw = {power}: laser 635 nm (LuxX) reports that its " in found[0].text
                assert found[0].text.endswith(f"(allowed: more than 0.1, at most 10). Remedy: {remedy}")
                run.close()


class Meter:
    """A power meter's place."""

    def read(self) -> float:
        return 0.0095

    def close(self) -> None:
        """Nothing is open."""


def test_the_self_test_compares_photodiode_own_reading_and_meter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """watts_per_count twice what it is for the first laser. Expected: refused with the counts and the value that the
    laser's own reading asks for; for the others the value that the power meter asks for.
    """
    quick(monkeypatch)
    monkeypatch.setattr("hw.rig.connect.Connector.meter", lambda connect: Meter())
    with served(RIG, 3, tmp_path / "ports") as path:
        content = path.read_text()
        right = float(re.findall(r"watts_per_count = (\S+)", content)[0])
        content = content.replace(f"watts_per_count = {right!r}", f"watts_per_count = {2 * right!r}", 1)
        path.write_text(content + '[power_meter]\nkind = "ophir"\nport = "/dev/ttyMETER"\n')
        found = {f.name: f.text for f in selftest(load_rig_file(path), None, armed=True)}
    first, second = found["laser 635 nm"], found["laser 532 nm"]
    said = re.search(r"gives 20.0\d mW \((\d+) counts\).*\(allowed: 1 to 15 mW\)", first)
    assert said and 1e-5 < right < 2.5e-5
    assert re.search(rf"Remedy: .*is near {0.01 / int(said[1]):.3g} by the laser's own reading", first)
    assert re.search(
        r"photodiode 10.0\d mW \((\d+) counts\), power meter 9.50 mW: watts_per_count = 1.\d+e-05;", second
    )
