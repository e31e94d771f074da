"""The stream: what is stored comes back, whatever happens to process, disk and bits."""

from __future__ import annotations

import errno
import math
import os
import random
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from capture_fakes import SHAPE, contents, fork, frame, small_plan
from damaged_images import damaged_images
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from hw.base.errors import DiscoError, InputError
from hw.record import RawImage
from pipeline.plan.plan import ImageAddress, Plan
from pipeline.stream import files, layout
from pipeline.stream.codec import decode, encode
from pipeline.stream.layout import ENTRY_BYTES, HEADER_BYTES
from pipeline.stream.stream import CorruptImage, ImageMeta, StorageError, StreamReader, StreamWriter

PLAN = small_plan()


def meta(index: int) -> ImageMeta:
    return ImageMeta(index / 15, 0.01 + 1e-5 * index, 0.7 * index, index, 2 * index)


def write(folder: Path, until: int, plan: Plan = PLAN) -> None:
    """Append the images that are missing up to number `until`."""
    with StreamWriter(folder, plan) as stream:
        for index in range(len(stream), until):
            stream.append(plan.address(index), frame(SHAPE, index), meta(index))


def same(a: RawImage | CorruptImage, b: RawImage) -> bool:
    assert isinstance(a, RawImage)
    return np.array_equal(a.exponent, b.exponent) and np.array_equal(a.charge, b.charge)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A complete stream, written without interruption. Not to be changed."""
    folder = tmp_path_factory.mktemp("finished")
    write(folder, len(PLAN))
    return folder


def round_trip(raw: RawImage) -> RawImage:
    with ThreadPoolExecutor(2) as pool:
        shared = encode(raw, pool)
    assert encode(raw) == shared  # the bytes do not depend on how many share the work
    decoded = decode(raw.exponent.shape, *shared)  # type: ignore[arg-type]
    assert decoded.exponent.dtype == np.uint8
    assert decoded.charge.dtype == np.uint16
    return decoded


@given(
    npst.arrays(np.uint8, st.tuples(st.integers(1, 40), st.integers(1, 40))),
    st.integers(0, 2**32 - 1),
    st.sampled_from(["noise", "dark", "zeros", "full", "gradient"]),
)
@settings(max_examples=60, deadline=None)
def test_every_record_comes_back(exponent: np.ndarray, seed: int, kind: str) -> None:
    rng, shape = np.random.default_rng(seed), exponent.shape
    charge = {
        "noise": rng.integers(0, 65536, shape),
        "dark": np.clip(64 + rng.standard_normal(shape), 0, 4095),
        "zeros": np.zeros(shape),
        "full": np.full(shape, 65535),
        "gradient": np.linspace(0, 65535, exponent.size).reshape(shape),
    }[kind].astype(np.uint16)
    raw = RawImage(exponent, charge)
    assert same(round_trip(raw), raw)


def test_a_large_record_comes_back_through_several_pieces_of_every_kind() -> None:
    """768 x 496 with noise from one count to the whole range: more than one piece, all kinds of run."""
    rng = np.random.default_rng(5)
    width = np.repeat(np.geomspace(1, 30000, 496)[:, None], 768, axis=1)
    width[:240] = 1.0
    charge = np.clip(32768 + width * rng.standard_normal(width.shape), 0, 65535).astype(np.uint16)
    raw = RawImage(rng.integers(0, 12, charge.shape, dtype=np.uint8), charge)
    assert same(round_trip(raw), raw)
    odd = RawImage(raw.exponent[:491, :763], raw.charge[:491, :763])
    assert same(round_trip(odd), odd)


def test_a_dark_record_is_stored_within_a_tenth_of_its_entropy() -> None:
    """Outside truth: read noise of one count that is rounded has an entropy of 2.10 bits (sum over -p log2 p)."""
    edges = np.arange(-6, 8) - 0.5
    p = np.diff([0.5 * (1 + math.erf(x / math.sqrt(2))) for x in edges])
    entropy = -(p * np.log2(p)).sum() / 8
    charge = np.rint(64 + np.random.default_rng(2).standard_normal((496, 768))).astype(np.uint16)
    parts = encode(RawImage(np.zeros(charge.shape, np.uint8), charge))
    assert 1.0 < sum(map(len, parts)) / (entropy * charge.size) < 1.1


def test_views_that_are_not_contiguous_come_back() -> None:
    raw = frame((40, 60), 1)
    strided = RawImage(raw.exponent[::2, ::-3], raw.charge[::2, ::-3])
    assert same(round_trip(strided), strided)


@pytest.mark.parametrize(
    "raw",
    [
        RawImage(np.zeros((2, 2), np.uint8), np.zeros((2, 3), np.uint16)),
        RawImage(np.zeros((2, 2), np.uint8), np.zeros((2, 2), np.int32)),  # type: ignore[arg-type]
        RawImage(np.zeros(4, np.uint8), np.zeros(4, np.uint16)),
        RawImage(np.zeros((0, 2), np.uint8), np.zeros((0, 2), np.uint16)),
    ],
)
def test_what_is_not_a_record_is_refused(tmp_path: Path, raw: RawImage) -> None:
    with StreamWriter(tmp_path, PLAN) as stream:
        with pytest.raises(ValueError, match="a record"):
            stream.append(PLAN.address(0), raw, meta(0))
        assert len(stream) == 0


def test_random_access_by_index_and_address(finished: Path) -> None:
    with StreamReader(finished) as stream:
        assert len(stream) == len(PLAN)
        assert stream.complete
        stream.require_complete()
        assert damaged_images(stream) == []
        order = list(range(len(PLAN)))
        random.Random(1).shuffle(order)
        for i in order:
            assert same(stream.read(i), frame(SHAPE, i))
            assert same(stream.read(PLAN.address(i)), frame(SHAPE, i))
            assert stream.meta(i) == stream.meta(PLAN.address(i)) == meta(i)
        assert all(same(a, frame(SHAPE, i)) for i, a in enumerate(stream))
        assert all(same(a, frame(SHAPE, i)) for i, a in zip(order, stream.read_many(order, ahead=3), strict=True))
        assert stream.bytes_stored == (finished / files.IMAGES).stat().st_size
        assert stream.bytes_raw() == 3 * 160 * len(PLAN)
        for outside in (-1, len(PLAN)):
            with pytest.raises(IndexError):
                stream.read(outside)


def test_read_many_may_be_left_early(finished: Path) -> None:
    with StreamReader(finished) as stream:
        images = stream.read_many(range(len(PLAN)))
        assert same(next(images), frame(SHAPE, 0))
        images.close()  # type: ignore[attr-defined]


def test_images_are_taken_in_the_plan_s_order_only(tmp_path: Path) -> None:
    with StreamWriter(tmp_path, PLAN) as stream, pytest.raises(ValueError, match="image 0 is next"):
        stream.append(PLAN.address(1), frame(SHAPE, 1), meta(1))


@pytest.mark.parametrize("pieces", [[0, 48], [1, 2, 3, 48], [7, 7, 31, 48], [47, 48]])
def test_a_stream_written_in_pieces_is_the_same(tmp_path: Path, finished: Path, pieces: list[int]) -> None:
    for until in pieces:
        write(tmp_path, until)
    assert contents(tmp_path) == contents(finished)


def test_opening_a_finished_stream_changes_nothing(tmp_path: Path, finished: Path) -> None:
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    write(tmp_path, len(PLAN))
    assert contents(tmp_path) == contents(finished)


def readable(folder: Path) -> list[int]:
    """The images that a reader returns; each must be right, every other must name itself."""
    with StreamReader(folder) as stream:
        images = list(stream)
        for i, image in enumerate(images):
            if isinstance(image, CorruptImage):
                assert image.index == i
                assert image.address == PLAN.address(i)
                assert str(PLAN.address(i)) in str(image)
            else:
                assert same(image, frame(SHAPE, i))
        return [i for i, image in enumerate(images) if not isinstance(image, CorruptImage)]


@pytest.mark.parametrize("name", [files.IMAGES, files.JOURNAL])
def test_a_flipped_bit_costs_one_image_at_most(tmp_path: Path, finished: Path, name: str) -> None:
    """One bit in every 97th byte and in every byte of the headers: only a payload's own image is lost."""
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    path = tmp_path / name
    original = path.read_bytes()
    with StreamReader(finished) as stream:
        entries = [stream._entry(i) for i in range(len(PLAN))]
    for at in sorted({*range(2 * HEADER_BYTES), *range(0, len(original), 97), len(original) - 1}):
        damaged = bytearray(original)
        damaged[at] ^= 1 << (at % 8)
        path.write_bytes(damaged)
        hit = [e.index for e in entries if name == files.IMAGES and e.payload_offset <= at < e.end]
        assert set(range(len(PLAN))) - set(readable(tmp_path)) == set(hit), f"byte {at}"


def test_a_flipped_bit_near_the_end_is_repaired_by_capturing_again(tmp_path: Path, finished: Path) -> None:
    """On opening to write, what is damaged at the end is dropped and appended again; entries and headers are healed."""
    for name in (files.IMAGES, files.JOURNAL):
        for at in (3, HEADER_BYTES + 5, HEADER_BYTES + ENTRY_BYTES + 9, -3):
            shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
            damaged = bytearray((tmp_path / name).read_bytes())
            damaged[at] ^= 16
            (tmp_path / name).write_bytes(damaged)
            write(tmp_path, len(PLAN))
            assert readable(tmp_path) == list(range(len(PLAN)))
            if name == files.JOURNAL or at != HEADER_BYTES + 5:  # a second copy of an entry is not rewritten
                assert contents(tmp_path) == contents(finished), (name, at)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.71, 0.999])
@pytest.mark.parametrize("name", [files.IMAGES, files.JOURNAL])
def test_a_truncated_stream_is_noticed_and_can_be_finished(
    tmp_path: Path, finished: Path, name: str, share: float
) -> None:
    """images.bin cut off: the images before the cut remain. The journal cut off: nothing is lost, it is a copy."""
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    size = (finished / name).stat().st_size
    os.truncate(tmp_path / name, int(share * size))
    with StreamReader(finished) as stream:
        kept = sum(stream._entry(i).end <= share * size for i in range(len(PLAN)))
    whole = len(PLAN) if name == files.JOURNAL else kept
    assert readable(tmp_path) == list(range(whole))
    if whole < len(PLAN):
        with StreamReader(tmp_path) as stream:
            assert not stream.complete
            with pytest.raises(InputError, match=f"ends after {whole} of {len(PLAN)} images"):
                stream.require_complete()
    write(tmp_path, len(PLAN))
    assert contents(tmp_path) == contents(finished)


def test_zeros_at_the_end_after_a_power_failure_are_dropped(
    tmp_path: Path, finished: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """File systems may keep a file's length and lose its last blocks."""
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    data = bytearray((tmp_path / files.IMAGES).read_bytes())
    data[-700:] = bytes(700)
    (tmp_path / files.IMAGES).write_bytes(data)
    write(tmp_path, len(PLAN))
    assert "will be taken again" in caplog.text
    assert contents(tmp_path) == contents(finished)


def test_junk_at_the_end_is_cut_off(tmp_path: Path, finished: Path) -> None:
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    for name in (files.IMAGES, files.JOURNAL):
        with (tmp_path / name).open("ab") as file:
            file.write(b"junk" * 50)
    assert readable(tmp_path) == list(range(len(PLAN)))
    write(tmp_path, len(PLAN))
    assert contents(tmp_path) == contents(finished)


def test_an_entry_in_the_wrong_place_is_not_believed(tmp_path: Path, finished: Path) -> None:
    """A misdirected write: image 7's entry, whole and with a right checksum, stands where image 5's belongs."""
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    journal = bytearray((tmp_path / files.JOURNAL).read_bytes())
    five, seven = (slice(HEADER_BYTES + i * ENTRY_BYTES, HEADER_BYTES + (i + 1) * ENTRY_BYTES) for i in (5, 7))
    journal[five] = journal[seven]
    (tmp_path / files.JOURNAL).write_bytes(journal)
    assert readable(tmp_path) == list(range(len(PLAN)))


def test_another_plan_s_folder_is_refused_and_left_alone(tmp_path: Path) -> None:
    write(tmp_path, 9)
    before = contents(tmp_path)
    with pytest.raises(InputError, match="another plan"):
        StreamWriter(tmp_path, small_plan((1, 1)))
    assert contents(tmp_path) == before


def test_a_damaged_plan_file_is_healed_by_its_plan(tmp_path: Path, finished: Path) -> None:
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    path = tmp_path / files.PLAN
    path.write_bytes(path.read_bytes().replace(b"0.7", b"0.8"))
    with pytest.raises(InputError, match="not the plan of this stream"):
        StreamReader(tmp_path)
    write(tmp_path, len(PLAN))
    assert contents(tmp_path) == contents(finished)


def test_foreign_files_and_empty_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"plan\.json"):
        StreamReader(tmp_path)
    (tmp_path / files.PLAN).write_text(PLAN.to_json())
    with pytest.raises(InputError, match="no stream"):
        StreamReader(tmp_path)
    (tmp_path / files.IMAGES).write_bytes(b"x" * 1000)
    with pytest.raises(InputError, match="not a stream"):
        StreamWriter(tmp_path, PLAN)
    assert (tmp_path / files.IMAGES).read_bytes() == b"x" * 1000


def test_another_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(layout, "FORMAT_VERSION", 1)
        write(tmp_path, 3)
    with pytest.raises(InputError, match="format_version = 1"):
        StreamReader(tmp_path)
    with pytest.raises(InputError, match="format_version = 1"):
        StreamWriter(tmp_path, PLAN)


def test_one_writer_at_a_time(tmp_path: Path) -> None:
    with StreamWriter(tmp_path, PLAN), pytest.raises(DiscoError, match="another process"):
        StreamWriter(tmp_path, PLAN)
    write(tmp_path, 1)  # the lock ends with the writer


def test_reading_while_writing(tmp_path: Path) -> None:
    with StreamWriter(tmp_path, PLAN) as stream:
        for i in range(5):
            with StreamReader(tmp_path) as reader:
                assert len(reader) == i
                assert not reader.complete
            stream.append(PLAN.address(i), frame(SHAPE, i), meta(i))
        assert stream.last_meta() == meta(4)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
@pytest.mark.parametrize("room", [0, 1, 63, 64, 200, -65, -64, -1])
def test_a_full_disk_is_one_line_and_loses_nothing(
    tmp_path: Path, finished: Path, monkeypatch: pytest.MonkeyPatch, room: int, code: int
) -> None:
    """The disk takes `room` bytes of image 11, or all but so many, a part of a write first as file systems do."""
    write(tmp_path, 11)
    with StreamReader(finished) as stream:
        entry = stream._entry(11)
    left, real = room % (entry.end - entry.offset + ENTRY_BYTES), os.pwrite

    def pwrite(file: int, data: bytes, offset: int) -> int:
        nonlocal left
        if left == 0:
            raise OSError(code, os.strerror(code))
        done = real(file, data[:left], offset)
        left -= done
        return done

    with StreamWriter(tmp_path, PLAN) as writer:
        with monkeypatch.context() as patch:
            patch.setattr(os, "pwrite", pwrite)
            with pytest.raises(StorageError, match="11 images are stored") as caught:
                writer.append(PLAN.address(11), frame(SHAPE, 11), meta(11))
        assert "\n" not in str(caught.value)
        assert ("the disk is full" in str(caught.value)) == (code == errno.ENOSPC)
        assert readable(tmp_path) == list(range(11))
        writer.append(PLAN.address(11), frame(SHAPE, 11), meta(11))  # room was made meanwhile
    write(tmp_path, len(PLAN))
    assert contents(tmp_path) == contents(finished)


def test_a_file_size_limit_of_the_system_is_a_full_disk(tmp_path: Path) -> None:
    """The real thing, in a process of its own: the kernel refuses to let images.bin grow beyond 3000 bytes."""

    def limited() -> None:
        import resource

        resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))
        try:
            write(tmp_path, len(PLAN))
        except StorageError as error:
            os._exit(42 if "the disk is full" in str(error) else 1)
        os._exit(2)

    child = fork(limited)
    child.join(60)
    assert child.exitcode == 42
    whole = readable(tmp_path)
    assert whole == list(range(len(whole)))
    assert len(whole) > 2


def test_addresses_are_readable() -> None:
    """str(ImageAddress) is what a user reads about a damaged image."""
    assert str(ImageAddress(2, "spot", 17, 1)) == "view 2, spot 17, laser 1"
    assert str(ImageAddress(2, "silhouette")) == "view 2, silhouette"
