"""The stream: an append-only container of raw images, in the order of a plan.

What `append` has returned survives a SIGKILL at any moment, and after `sync` a power failure. A stream that was
interrupted and finished equals an uninterrupted one byte for byte. Damage costs the image that it hits, which is
reported with its address, and no other. POSIX only (pread, flock).
"""

from __future__ import annotations

import logging
import os
import zlib
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Self

from hw.base.errors import DiscoError, InputError
from hw.base.files import take_lock, write_atomically
from hw.base.resources import usable_cores
from hw.record import RawImage
from pipeline.plan.plan import ImageAddress, Plan, load_plan
from pipeline.stream.codec import decode, encode
from pipeline.stream.files import IMAGES, PLAN, StorageError, StreamFiles, end_of, storage_error, write_at
from pipeline.stream.layout import ENTRY_BYTES, HEADER_BYTES, IMAGES_MAGIC, JOURNAL_MAGIC, Entry, ImageMeta, pack_header

__all__ = ["CorruptImage", "ImageMeta", "StorageError", "StreamReader", "StreamWriter"]

SYNC_EVERY = 256  # images; a power failure can damage at most this many at the end, and opening to write checks them

log = logging.getLogger(__name__)


class CorruptImage(DiscoError):
    """One stored image is damaged; the others are not concerned. `index`, `address`: which."""

    def __init__(self, index: int, address: ImageAddress, reason: str) -> None:
        self.index, self.address = index, address
        super().__init__(f"image {index} ({address}) is damaged: {reason}")


class StreamWriter:
    """Appends images to the stream of a plan in a folder; opening an unfinished stream continues it.

    An image that was damaged at the very end (a crash of the machine) is dropped on opening, with a warning, and is
    to be appended again: `len` is the number of the next image. One process at a time.

    Raises: StorageError where the disk refuses; InputError for another plan's folder; DiscoError while it is in use.
    """

    def __init__(self, folder: Path, plan: Plan) -> None:
        self.plan, self.folder = plan, folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._files = StreamFiles(folder, os.O_RDWR | os.O_CREAT)
        except OSError as error:
            raise storage_error(folder, 0, error) from error
        try:
            self._lock(folder)
            self._claim(folder)
            self._place = self._recover()  # (number of images, end of the last in images.bin)
        except BaseException:
            self._files.close()
            raise
        self._pool = ThreadPoolExecutor(usable_cores(), thread_name_prefix="encode")

    def _lock(self, folder: Path) -> None:
        if not take_lock(self._files.images):
            raise DiscoError(
                f"{folder}: another process is capturing into this folder. Remedy: wait for it, or choose another"
            )

    def _claim(self, folder: Path) -> None:
        """Make sure that the folder is this plan's; a header or plan.json that was damaged is written anew."""
        found, files = self._files.digest(), self._files
        if found is None and max(os.fstat(f).st_size for f in (files.images, files.journal)) > HEADER_BYTES:
            raise InputError("not a stream", file=folder / IMAGES, remedy="choose another output folder")
        if found not in (None, self.plan.digest):
            raise InputError("this folder holds the capture of another plan", file=folder, remedy="choose another one")
        text = self.plan.to_json().encode()
        path = folder / PLAN
        try:
            if not path.exists() or path.read_bytes() != text:
                write_atomically(path, text)
            for file, magic in ((files.images, IMAGES_MAGIC), (files.journal, JOURNAL_MAGIC)):
                header = pack_header(magic, self.plan.digest)
                if os.pread(file, HEADER_BYTES, 0) != header:
                    write_at(file, header, 0)
        except OSError as error:
            raise storage_error(folder, 0, error) from error

    def _recover(self) -> tuple[int, int]:
        """Drop what is incomplete or damaged at the end, and bring the journal up to it."""
        files = self._files
        found, end = files.extent()
        count = next((i for i in range(max(0, found - SYNC_EVERY), found) if not files.intact(i)), found)
        if count < found:
            log.warning("%s: the last %d images are damaged and will be taken again", files.folder, found - count)
            end = end_of(files.entry(count - 1) if count else None)
        journalled = max(0, os.fstat(files.journal).st_size - HEADER_BYTES) // ENTRY_BYTES
        try:
            for i in range(min(journalled, max(0, count - SYNC_EVERY)), count):
                entry = files.entry(i)
                if entry is not None:
                    write_at(files.journal, entry.pack(), HEADER_BYTES + i * ENTRY_BYTES)
            os.ftruncate(files.images, end)
            os.ftruncate(files.journal, HEADER_BYTES + count * ENTRY_BYTES)
        except OSError as error:
            raise storage_error(files.folder, count, error) from error
        return count, end

    def __len__(self) -> int:
        """Number of images stored: the index of the next one."""
        return self._place[0]

    @property
    def complete(self) -> bool:
        return len(self) == len(self.plan)

    def last_meta(self) -> ImageMeta | None:
        """The rig's state at the last stored image; None while the stream is empty."""
        entry = self._files.entry(len(self) - 1) if len(self) else None
        return None if entry is None else entry.meta

    def append(self, address: ImageAddress, raw: RawImage, meta: ImageMeta) -> None:
        """Store the next image of the plan. When this returns, the image survives the end of the process."""
        count, end = self._place
        if self.plan.index(address) != count:
            raise ValueError(f"{address} is image {self.plan.index(address)}, but image {count} is next")
        exponent, charge = encode(raw, self._pool)
        crc = zlib.crc32(charge, zlib.crc32(exponent))
        height, width = raw.exponent.shape
        entry = Entry(count, height, width, end, len(exponent), len(charge), meta, crc)
        packed = entry.pack()
        try:
            write_at(self._files.images, packed + exponent + charge, end)
            write_at(self._files.journal, packed, HEADER_BYTES + count * ENTRY_BYTES)
            self._place = count + 1, entry.end
            if (count + 1) % SYNC_EVERY == 0:
                self.sync()
        except BaseException as error:
            self._place = count, end
            self._cut()
            if isinstance(error, OSError):
                raise storage_error(self._files.folder, count, error) from error
            raise

    def _cut(self) -> None:
        """Take back an image that was not stored in full. Where even this fails, the next opening does it."""
        count, end = self._place
        try:
            os.ftruncate(self._files.journal, HEADER_BYTES + count * ENTRY_BYTES)
            os.ftruncate(self._files.images, end)
        except OSError as error:
            log.warning("%s: the unfinished image %d stays until the next start: %s", self._files.folder, count, error)

    def sync(self) -> None:
        """Bring everything onto the disk itself, images before the journal that points at them."""
        os.fsync(self._files.images)
        os.fsync(self._files.journal)

    def close(self) -> None:
        """Sync and release the folder."""
        try:
            self.sync()
        except OSError as error:
            raise storage_error(self._files.folder, len(self), error) from error
        finally:
            self._pool.shutdown()
            self._files.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class StreamReader:
    """Random access to a stream, finished or not, from several threads. Raises: InputError where there is none."""

    def __init__(self, folder: Path) -> None:
        self.plan, self.folder = load_plan(folder / PLAN), folder
        try:
            self._files = StreamFiles(folder, os.O_RDONLY)
        except OSError as error:
            raise InputError(f"no stream ({error.strerror})", file=folder, remedy="run the capture first") from error
        digest = self._files.digest()
        if digest != self.plan.digest:
            self._files.close()
            reason = "not a stream" if digest is None else "plan.json is not the plan of this stream"
            raise InputError(reason, file=folder / IMAGES, remedy="repeat the capture command")
        self._count, self.bytes_stored = self._files.extent()

    def __len__(self) -> int:
        """Number of images stored in full."""
        return self._count

    @property
    def complete(self) -> bool:
        """Whether every image of the plan is there."""
        return len(self) == len(self.plan)

    def require_complete(self) -> None:
        """Raises: InputError for a stream that was cut off."""
        if not self.complete:
            raise InputError(
                f"the stream ends after {len(self)} of {len(self.plan)} images",
                file=self._files.folder / IMAGES,
                remedy="repeat the capture command: it continues there",
            )

    def _entry(self, which: int | ImageAddress) -> Entry:
        index = self.plan.index(which) if isinstance(which, ImageAddress) else which
        if not 0 <= index < len(self):
            raise IndexError(f"image {index} of a stream of {len(self)}")
        entry = self._files.entry(index)
        if entry is None:
            raise CorruptImage(index, self.plan.address(index), "both copies of its entry")
        return entry

    def meta(self, which: int | ImageAddress) -> ImageMeta:
        """The rig's state at an image, by its index or address."""
        return self._entry(which).meta

    def read(self, which: int | ImageAddress) -> RawImage:
        """An image, by its index or address. Raises `CorruptImage`."""
        entry = self._entry(which)
        payload = self._files.payload(entry)
        if payload is None:
            raise CorruptImage(entry.index, self.plan.address(entry.index), "its checksum differs")
        exponents, charges = payload[: entry.exponent_bytes], payload[entry.exponent_bytes :]
        return decode((entry.height, entry.width), exponents, charges)

    def _read_or_reason(self, which: int | ImageAddress) -> RawImage | CorruptImage:
        try:
            return self.read(which)
        except CorruptImage as corrupt:
            return corrupt

    def read_many(
        self, which: Iterable[int | ImageAddress], workers: int = 2, ahead: int = 16
    ) -> Iterator[RawImage | CorruptImage]:
        """Images in the order asked for, decoded by `workers` threads at most `ahead` images before they are needed.

        In the place of a damaged image stands its `CorruptImage`, so that the others are still read.
        """
        pending: deque[Future[RawImage | CorruptImage]] = deque()
        with ThreadPoolExecutor(workers, thread_name_prefix="decode") as pool:
            try:
                for item in which:
                    pending.append(pool.submit(self._read_or_reason, item))
                    if len(pending) > ahead:
                        yield pending.popleft().result()
                while pending:
                    yield pending.popleft().result()
            finally:
                pool.shutdown(cancel_futures=True)

    def __iter__(self) -> Iterator[RawImage | CorruptImage]:
        """All images in order, as `read_many`."""
        return self.read_many(range(len(self)))

    def bytes_raw(self) -> int:
        """Size of all images uncompressed, three bytes a pixel."""
        return sum(e.height * e.width * 3 for e in map(self._files.entry, range(len(self))) if e is not None)

    def close(self) -> None:
        self._files.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
