"""The bytes of a stream: file header, entry, payload. See docs/decisions for the container's choice.

`images.bin` = header, then per image its entry and its payload. `journal.bin` = header, then the entries again,
64 bytes an image, so that image i is found without a search. Everything that finds or describes an image therefore
exists twice, and a flipped bit anywhere costs at most the one image whose payload it hits. All integers and floats
are little-endian.

The payload is what `pipeline.stream.codec` makes of a record, exponents before charges.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

FORMAT_VERSION = 4
IMAGES_MAGIC = b"DISCOIMG"
JOURNAL_MAGIC = b"DISCOJRN"

_HEADER = struct.Struct("<8sI32s16xI")  # magic, format version, digest of the plan, CRC-32 of what precedes
HEADER_BYTES = _HEADER.size
# index, height, width, offset, bytes of exponents and of charges, time, photodiode, angle, u, v, CRCs of payload, entry
_ENTRY = struct.Struct("<IHHQIIdddiiII")
ENTRY_BYTES = _ENTRY.size


@dataclass(frozen=True)
class ImageMeta:
    """The rig's state at one image.

    time_s is the rig's clock when the image was complete (gate shut, photodiode read); photodiode_w the mean power
    over the exposure (0 for a silhouette); angle_rad the turntable's; u, v the mirror steps (-1 for a silhouette).
    """

    time_s: float
    photodiode_w: float
    angle_rad: float
    u: int
    v: int


@dataclass(frozen=True)
class Entry:
    """Where an image lies in images.bin and what was noted with it. `offset` is that of its own copy of the entry."""

    index: int
    height: int
    width: int
    offset: int
    exponent_bytes: int
    charge_bytes: int
    meta: ImageMeta
    payload_crc: int

    @property
    def payload_offset(self) -> int:
        return self.offset + ENTRY_BYTES

    @property
    def payload_bytes(self) -> int:
        return self.exponent_bytes + self.charge_bytes

    @property
    def end(self) -> int:
        """Where the next image begins."""
        return self.payload_offset + self.payload_bytes

    def pack(self) -> bytes:
        m = self.meta
        place = (self.index, self.height, self.width, self.offset, self.exponent_bytes, self.charge_bytes)
        body = _ENTRY.pack(*place, m.time_s, m.photodiode_w, m.angle_rad, m.u, m.v, self.payload_crc, 0)[:-4]
        return body + zlib.crc32(body).to_bytes(4, "little")

    @classmethod
    def unpack(cls, data: bytes, index: int) -> Entry | None:
        """The entry of image `index`, or None if these bytes are not it, undamaged."""
        if len(data) != ENTRY_BYTES or zlib.crc32(data[:-4]) != int.from_bytes(data[-4:], "little"):
            return None
        found, height, width, offset, exponents, charges, time, power, angle, u, v, crc, _ = _ENTRY.unpack(data)
        meta = ImageMeta(time, power, angle, u, v)
        return cls(found, height, width, offset, exponents, charges, meta, crc) if found == index else None


def pack_header(magic: bytes, digest: bytes) -> bytes:
    """The first bytes of a file that belongs to the plan with this digest."""
    body = _HEADER.pack(magic, FORMAT_VERSION, digest, 0)[:-4]
    return body + zlib.crc32(body).to_bytes(4, "little")


def unpack_header(data: bytes, magic: bytes) -> tuple[int, bytes] | None:
    """(format version, digest of the plan), or None if the header is damaged or another file's."""
    if len(data) != HEADER_BYTES or zlib.crc32(data[:-4]) != int.from_bytes(data[-4:], "little"):
        return None
    found, version, digest, _ = _HEADER.unpack(data)
    return (version, digest) if found == magic else None
