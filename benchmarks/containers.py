"""Containers that a stream could be, one image at a time: zarr, HDF5 and Blosc2 as their users would write it.

Each gets a record's two arrays, chunked by image, in its fastest well-packing codec, and has what it was given handed
to the operating system after every image, since that is what an append promises. One thread.
"""

from __future__ import annotations

import importlib.util
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hw.record import RawImage
from pipeline.plan.plan import Plan
from pipeline.stream.stream import ImageMeta, StreamReader, StreamWriter

Read = Callable[[int], object]
Container = tuple[Callable[[int, RawImage], object], Callable[[], Read]]  # append an image; finish, then read one


def container_rows(folder: Path, records: Sequence[RawImage]) -> list[dict[str, Any]]:
    """Rows {container, ratio, append_ms, read_ms, files}, medians over the images, which all take in turn.

    Containers that are not installed are left out.
    """
    openers = {"stream": _stream, "zarr": _zarr, "h5py": _hdf5, "blosc2": _blosc2}
    present = [name for name in openers if name == "stream" or importlib.util.find_spec(name) is not None]
    places = {name: folder / f"container-{name}" for name in present}
    opened = {}
    for name, place in places.items():
        place.mkdir()
        opened[name] = openers[name](place, records[0].charge.shape, len(records))
    appended = [{name: _ms(opened[name][0], *item) for name in present} for item in enumerate(records)]
    readers = {name: finish() for name, (_, finish) in opened.items()}
    order = np.random.default_rng(2).permutation(len(records)).tolist()
    taken = [{name: _ms(readers[name], index) for name in present} for index in order]
    raw = sum(3 * record.exponent.size for record in records)
    rows = []
    for name, place in places.items():
        files = [path for path in place.rglob("*") if path.is_file()]
        rows.append(
            {
                "container": name,
                "ratio": raw / sum(path.stat().st_size for path in files),
                "append_ms": statistics.median(row[name] for row in appended),
                "read_ms": statistics.median(row[name] for row in taken),
                "files": len(files),
            }
        )
    return rows


def _ms(work: Callable[..., object], *arguments: object) -> float:
    start = time.perf_counter()
    work(*arguments)
    return 1e3 * (time.perf_counter() - start)


def _stream(folder: Path, shape: tuple[int, int], count: int) -> Container:
    from hw.interface import Aim

    plan = Plan(("camera",), (0.0,), tuple(Aim(0, i, 0) for i in range(count)), 1)
    writer = StreamWriter(folder, plan)

    def finish() -> Read:
        writer.close()
        return StreamReader(folder).read

    return lambda index, raw: writer.append(plan.address(index), raw, ImageMeta(0.0, 0.0, 0.0, 0, 0)), finish


def _zarr(folder: Path, shape: tuple[int, int], count: int) -> Container:
    import zarr
    from zarr.codecs import BloscCodec, BloscShuffle

    def array(name: str, dtype: str, shuffle: BloscShuffle) -> Any:
        return zarr.create_array(
            store=str(folder / name), shape=(count, *shape), chunks=(1, *shape), dtype=dtype,
            compressors=BloscCodec(cname="zstd", clevel=1, shuffle=shuffle),
        )  # fmt: skip

    exponent = array("exponent", "u1", BloscShuffle.noshuffle)
    charge = array("charge", "u2", BloscShuffle.shuffle)

    def append(index: int, raw: RawImage) -> None:
        exponent[index], charge[index] = raw.exponent, raw.charge

    return append, lambda: lambda index: (exponent[index], charge[index])


def _hdf5(folder: Path, shape: tuple[int, int], count: int) -> Container:
    import h5py

    file = h5py.File(folder / "capture.h5", "w", libver="latest")
    options = {"maxshape": (None, *shape), "chunks": (1, *shape), "compression": "gzip", "compression_opts": 1}
    exponent = file.create_dataset("exponent", (0, *shape), "u1", **options)
    charge = file.create_dataset("charge", (0, *shape), "u2", shuffle=True, **options)
    file.swmr_mode = True

    def append(index: int, raw: RawImage) -> None:
        for data, values in ((exponent, raw.exponent), (charge, raw.charge)):
            data.resize(index + 1, axis=0)
            data[index] = values
            data.flush()

    def finish() -> Read:
        file.close()
        again = h5py.File(folder / "capture.h5", swmr=True)
        return lambda index: (again["exponent"][index], again["charge"][index])

    return append, finish


def _blosc2(folder: Path, shape: tuple[int, int], count: int) -> Container:
    import blosc2

    def schunk(name: str, typesize: int) -> Any:
        settings = {"codec": blosc2.Codec.ZSTD, "clevel": 1, "typesize": typesize, "nthreads": 1}
        size = typesize * shape[0] * shape[1]
        return blosc2.SChunk(size, contiguous=True, urlpath=str(folder / name), cparams=settings)

    exponent, charge = schunk("exponent.b2", 1), schunk("charge.b2", 2)

    def append(index: int, raw: RawImage) -> None:
        exponent.append_data(raw.exponent)
        charge.append_data(raw.charge)

    def read(index: int) -> object:
        return (
            np.frombuffer(exponent.decompress_chunk(index), np.uint8),
            np.frombuffer(charge.decompress_chunk(index), np.uint16),
        )

    return append, lambda: read
