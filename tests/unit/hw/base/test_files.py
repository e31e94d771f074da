"""Files are replaced as a whole, and what is not ours is refused in one line."""

from __future__ import annotations

import itertools
import json
import os
from pathlib import Path

import numpy as np
import pytest

from hw.base.errors import InputError
from hw.base.files import load_arrays, replacing, save_arrays, take_lock, write_atomically, write_json


def test_a_failure_leaves_the_old_content_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_atomically(path, b"old")
    with pytest.raises(KeyboardInterrupt), replacing(path):
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_a_disk_that_refuses_names_the_file_and_keeps_nothing(tmp_path: Path) -> None:
    path = tmp_path / "file"
    with pytest.raises(OSError, match="No space left") as caught, replacing(path):
        raise OSError(28, "No space left on device")
    assert caught.value.filename == str(path) and not list(tmp_path.iterdir())


def test_what_is_not_of_the_disk_stays_as_it_is(tmp_path: Path) -> None:
    """An input that is missing is not the output's fault, and what has no number has a text."""
    path = tmp_path / "file"
    with pytest.raises(FileNotFoundError) as caught, replacing(path):
        (tmp_path / "input").read_bytes()
    assert caught.value.filename == str(tmp_path / "input")
    with pytest.raises(OSError, match="16 requested and 0 written"), replacing(path):
        raise OSError("16 requested and 0 written")
    assert not list(tmp_path.iterdir())


def test_a_replaced_file_keeps_its_mode_and_its_links(tmp_path: Path) -> None:
    path, link = tmp_path / "file", tmp_path / "link"
    path.write_bytes(b"old")
    path.chmod(0o400)
    (tmp_path / "file.part").touch(0o400)  # of a run that was killed
    link.symlink_to(path)
    write_atomically(link, b"new")
    assert link.is_symlink() and path.read_bytes() == b"new" and path.stat().st_mode & 0o777 == 0o400
    assert {*tmp_path.iterdir()} == {path, link}


def test_json_holds_no_nan(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "a.json", {"x": float("nan")})
    assert not list(tmp_path.iterdir())


def test_arrays_come_back_with_their_head(tmp_path: Path) -> None:
    path, values = tmp_path / "a.npz", np.arange(6.0).reshape(2, 3)
    save_arrays(path, 3, {"values": values, "more": np.array([True])}, units="mm")
    head, arrays = load_arrays(path, 3, "make it again")
    assert head == {"format_version": 3, "units": "mm"} and set(arrays) == {"values", "more"}
    np.testing.assert_array_equal(arrays["values"], values)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is damaged"),
        (b"PK\x03\x04 and then nothing", "is damaged"),
        (json.dumps({"format_version": 3}).encode(), "is damaged"),
        (None, "is missing"),
    ],
)
def test_what_is_no_archive_is_refused(tmp_path: Path, content: bytes | None, says: str) -> None:
    path = tmp_path / "a.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=rf"a\.npz: .*{says}.*make it again"):
        load_arrays(path, 3, "make it again")


def test_no_changed_byte_is_a_traceback(tmp_path: Path) -> None:
    """Each byte of a small file in turn: a flipped bit, the last bit, all ones."""
    path, values = tmp_path / "a.npz", np.arange(4.0)
    save_arrays(path, 3, {"values": values})
    whole, refused = path.read_bytes(), 0
    for place, change in itertools.product(range(len(whole)), (0x01, 0x08, 0x10, 0x40, 0xFF)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ change]) + whole[place + 1 :])
        try:
            _, arrays = load_arrays(path, 3, "make it again", ["values"])
        except InputError:
            refused += 1
        else:
            np.testing.assert_array_equal(arrays["values"], values)  # a byte that nothing depends on
    assert refused > len(whole)


def test_other_versions_and_lacking_arrays_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    save_arrays(path, 2, {"values": np.zeros(1)})
    with pytest.raises(InputError, match=r"format_version = 2: another format.*3"):
        load_arrays(path, 3, "make it again")
    with pytest.raises(InputError, match=r"lacks.*weights"):
        load_arrays(path, 2, "make it again", ["weights"])
    np.savez(path, format_version=1, values=np.zeros(1))  # from before heads
    with pytest.raises(InputError, match="another format"):
        load_arrays(path, 3, "make it again")


def test_one_lock_a_folder(tmp_path: Path) -> None:
    first, second = os.open(tmp_path, os.O_RDONLY), os.open(tmp_path, os.O_RDONLY)
    assert take_lock(first) and not take_lock(second)
    os.close(first)
    assert take_lock(second)
    os.close(second)
