"""The stream of raw records beside bzip2 (the thesis's codec, 5.1) and beside other containers.

Frames are captured by the twin (`benchmarks.frames`). All figures come from alternating rounds of one run and include
everything between a record in memory and the file: `append` with its fsync at the end, `read_many` with its
checksums, from a warm page cache. bzip2 is given the layout of a record that it packs best and as many threads; what
it writes and reads stays in memory.
"""

from __future__ import annotations

import bz2
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.containers import container_rows
from benchmarks.frames import capture_frames
from hw.record import RawImage
from pipeline.stream.layout import ImageMeta
from pipeline.stream.stream import StreamReader, StreamWriter

THREADS = 2
LAYOUTS: dict[str, Callable[[RawImage], bytes]] = {
    "exponents, then charges": lambda raw: raw.exponent.tobytes() + raw.charge.tobytes(),
    "pixel by pixel": lambda raw: np.rec.fromarrays([raw.exponent, raw.charge]).tobytes(),
    "byte planes": lambda raw: (
        raw.exponent.tobytes() + (raw.charge & 255).astype("u1").tobytes() + (raw.charge >> 8).astype("u1").tobytes()
    ),
}


def run(quick: bool = False) -> dict[str, Any]:
    """Keys of benchmarks.md, CPU milliseconds an image, and `containers` rows."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        capture_frames(folder, *((3, 50_000) if quick else (12, 200_000)))
        with StreamReader(folder / "capture") as stream:
            plan, stored = stream.plan, len(stream)
            spots = [i for i in range(stored) if plan.address(i).kind == "spot"]
            records = [stream.read(i) for i in range(stored)]
            metas = [stream.meta(i) for i in range(stored)]
        layout, packed = _best_bzip2(records)
        raw = sum(3 * r.exponent.size for r in records)
        rounds = _rounds(folder, plan, records, metas, packed, 3 if quick else 7)
        figures: dict[str, Any] = {
            "images": stored,
            "spot_images": len(spots),
            "width": records[0].charge.shape[1],
            "height": records[0].charge.shape[0],
            "threads": THREADS,
            "ratio": raw / sum(p.stat().st_size for p in (folder / "round").glob("*.bin")),
            "bzip2_ratio": raw / sum(map(len, packed)),
            "bzip2_layout": layout,
        }
        figures["ratio_over_bzip2"] = figures["ratio"] / figures["bzip2_ratio"]
        for name, values in rounds.items():
            figures |= {name: statistics.median(values), f"{name}_min": min(values), f"{name}_max": max(values)}
        figures["decode_over_bzip2"] = statistics.median(
            [a / b for a, b in zip(rounds["decode_images_per_s"], rounds["bzip2_decode_images_per_s"], strict=True)]
        )
        figures["containers"] = container_rows(folder, records[:12] if quick else records[:30])
    return {"name": "stream", "quick": quick, **figures}


def _best_bzip2(records: Sequence[RawImage]) -> tuple[str, list[bytes]]:
    """The layout that bzip2 -9 packs best, and all records packed in it."""
    with ThreadPoolExecutor(THREADS) as pool:
        packed = {name: list(pool.map(bz2.compress, map(lay, records))) for name, lay in LAYOUTS.items()}
    best = min(packed, key=lambda name: sum(map(len, packed[name])))
    return best, packed[best]


def _rounds(
    folder: Path, plan: Any, records: Sequence[RawImage], metas: Sequence[ImageMeta], packed: list[bytes], rounds: int
) -> dict[str, list[float]]:
    """Figures of every round: what is written, read, and read by bzip2, one after another."""
    out: dict[str, list[float]] = {}
    count, into, choose = len(records), folder / "round", np.random.default_rng(1)

    def note(name: str, work: Callable[[], object]) -> None:
        cpu, start = time.process_time(), time.perf_counter()
        work()
        out.setdefault(f"{name}_images_per_s", []).append(count / (time.perf_counter() - start))
        out.setdefault(f"{name}_cpu_ms", []).append(1e3 * (time.process_time() - cpu) / count)

    def write() -> None:
        with StreamWriter(into, plan) as stream:
            for index, (record, meta) in enumerate(zip(records, metas, strict=True)):
                stream.append(plan.address(index), record, meta)

    def unpack() -> None:
        with ThreadPoolExecutor(THREADS) as pool:
            for _ in pool.map(bz2.decompress, packed):
                pass

    for _ in range(rounds):
        for file in into.glob("*"):
            file.unlink()
        note("encode", write)
        with StreamReader(into) as stream:
            note("decode", lambda: [None for _ in stream.read_many(range(count), THREADS)])
            single = []
            for index in choose.permutation(count).tolist():
                start = time.perf_counter()
                stream.read(index)
                single.append(1e3 * (time.perf_counter() - start))
            out.setdefault("random_ms_median", []).append(statistics.median(single))
        note("bzip2_decode", unpack)
    return out
