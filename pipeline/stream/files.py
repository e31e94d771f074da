"""A stream's two files on disk: where an image lies, how far the stream reaches, what the disk refuses."""

from __future__ import annotations

import errno
import os
import zlib
from pathlib import Path

from hw.base.errors import DiscoError, InputError
from pipeline.stream.layout import (
    ENTRY_BYTES,
    FORMAT_VERSION,
    HEADER_BYTES,
    IMAGES_MAGIC,
    JOURNAL_MAGIC,
    Entry,
    unpack_header,
)

PLAN, IMAGES, JOURNAL = "plan.json", "images.bin", "journal.bin"


class StorageError(DiscoError):
    """The disk refused to take an image; what was stored before is intact."""


class StreamFiles:
    """Both files of a stream, open; finds entries by whichever of their two copies is undamaged."""

    def __init__(self, folder: Path, flags: int) -> None:
        self.folder = folder
        self.images = os.open(folder / IMAGES, flags, 0o644)
        try:
            self.journal = os.open(folder / JOURNAL, flags, 0o644)
        except BaseException:
            os.close(self.images)
            raise

    def close(self) -> None:
        os.close(self.images)
        os.close(self.journal)

    def digest(self) -> bytes | None:
        """Digest of the plan that this stream belongs to; None if neither file has a header.

        Raises: InputError for another format version.
        """
        for file, magic in ((self.images, IMAGES_MAGIC), (self.journal, JOURNAL_MAGIC)):
            header = unpack_header(os.pread(file, HEADER_BYTES, 0), magic)
            if header is not None and header[0] != FORMAT_VERSION:
                raise InputError(
                    "another version's stream",
                    file=self.folder / IMAGES,
                    key="format_version",
                    value=header[0],
                    allowed=str(FORMAT_VERSION),
                    remedy="capture again into another folder",
                )
            if header is not None:
                return header[1]
        return None

    def entry(self, index: int) -> Entry | None:
        """Entry of an image: from the journal, or else from its copy before the image; None if both are damaged."""
        found = self._journalled(index)
        if found is not None:
            return found
        before, last = index - 1, None
        while before >= 0 and (last := self._journalled(before)) is None:
            before -= 1
        for i in range(before + 1, index + 1):
            last = Entry.unpack(os.pread(self.images, ENTRY_BYTES, end_of(last)), i)
            if last is None:
                return None
        return last

    def _journalled(self, index: int) -> Entry | None:
        return Entry.unpack(os.pread(self.journal, ENTRY_BYTES, HEADER_BYTES + index * ENTRY_BYTES), index)

    def payload(self, entry: Entry) -> bytes | None:
        """What is stored of an image; None if it is not what was written."""
        data = os.pread(self.images, entry.payload_bytes, entry.payload_offset)
        return data if len(data) == entry.payload_bytes and zlib.crc32(data) == entry.payload_crc else None

    def intact(self, index: int) -> bool:
        """Whether an image can be found and its checksum is right."""
        entry = self.entry(index)
        return entry is not None and self.payload(entry) is not None

    def extent(self) -> tuple[int, int]:
        """(number of images, end of the last one in images.bin): what is there in full.

        The journal's entries as far as images.bin reaches, and images beyond the journal's end (a process that was
        killed between the two writes, a journal that was cut off).
        """
        size = os.fstat(self.images).st_size
        count = max(0, os.fstat(self.journal).st_size - HEADER_BYTES) // ENTRY_BYTES
        last = None
        while count and ((last := self.entry(count - 1)) is None or last.end > size):
            count, last = count - 1, None
        end = end_of(last)
        while True:
            further = Entry.unpack(os.pread(self.images, ENTRY_BYTES, end), count)
            if further is None or self.payload(further) is None:
                return count, end
            count, end = count + 1, further.end


def end_of(last: Entry | None) -> int:
    """Where the image after `last` begins in images.bin."""
    return HEADER_BYTES if last is None else last.end


def write_at(file: int, data: bytes, offset: int) -> None:
    """pwrite until all of it is written: a nearly full disk takes a part first."""
    while data:
        done = os.pwrite(file, data, offset)
        data, offset = data[done:], offset + done


def storage_error(folder: Path, stored: int, error: OSError) -> StorageError:
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    reason, remedy = ("the disk is full", "make room") if full else (error.strerror or str(error), "check the disk")
    return StorageError(f"{folder}: {reason}; {stored} images are stored. Remedy: {remedy}, repeat the same command")
