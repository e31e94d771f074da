"""Files: what was saved is what is loaded, from the smallest entry to the largest; what cannot be held is refused."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh

from benchmarks.stability.case import Ends, Family, relative
from hw.base.arrays import F64
from hw.record import RawImage
from pipeline.geometry.fresnel import Boundary
from pipeline.model.lambertian import LambertianTerm
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.stream.codec import decode, encode

FAMILY = Family("files")
MESH = trimesh.creation.icosphere(subdivisions=1, radius=10.0)
COUNT = len(MESH.vertices)


def symmetric(decades: float, top: float = 1.0) -> F64:
    """(1, V, V) R_d over so many decades below `top`."""
    exponent = np.random.default_rng(0).uniform(-decades, 0, (COUNT, COUNT))
    return np.asarray(top * 10.0 ** np.maximum(exponent, exponent.T))[None]


def model(reflectance: Any, variance: Any = None) -> RelightableModel:
    term = GlobalTerm(np.asarray(reflectance, np.float32), np.ones((COUNT, COUNT), bool), variance)
    return RelightableModel(MESH, Boundary(1.3), (term,))


def saved_off(decades: float, top: float = 1.0) -> float:
    """Largest relative difference between what was meant and what was loaded, entries and their deviations."""
    exact = symmetric(decades, top)
    with np.errstate(all="ignore"):
        kept = model(exact, (0.01 * exact**2).astype(np.float32))
    with TemporaryDirectory() as folder:
        kept.save(Path(folder) / "model.npz")
        loaded = RelightableModel.load(Path(folder) / "model.npz")
    columns = loaded.reflectance_columns(np.arange(COUNT))
    assert columns is not None and columns.variance is not None
    spread = np.sqrt(columns.variance.astype(np.float64))
    return max(relative(columns.mean, exact), relative(spread, 0.1 * exact))


for decades, top in ((12.0, 1.0), (12.0, 1e-6)):
    FAMILY.case(
        f"R_d over {decades:g} decades below {top:g}, saved and loaded",
        "every entry and deviation to 1e-6",
        f"{top * 10**-decades:.0e} .. {top:g} / mm^2",
        1e-6,
    )(partial(saved_off, decades, top))


def model_file(change: Any, made: RelightableModel | None = None) -> float:
    """A saved model whose file's arrays were changed. made: with entries and variances, where it is not stated."""
    exact = symmetric(3.0)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "model.npz"
        (made or model(exact, (0.01 * exact**2).astype(np.float32))).save(path)
        with np.load(path) as data:
            arrays = {name: data[name] for name in data.files}
        change(arrays)
        np.savez(path, **arrays)
        RelightableModel.load(path)
    return 1.0


def set_item(name: str, value: Any) -> Any:
    return lambda arrays: arrays.update({name: value})


def set_entry(name: str, value: float) -> Any:
    return lambda arrays: arrays[name].__setitem__((0, 3, 4), value)


NOT_FINITE, NOT_SYMMETRIC = "global.reflectance: holds values that are not finite", "reflectance: is not symmetric"
VERTICES, FACES = "vertices are not (V, 3) finite numbers", "faces are not (F, 3) whole numbers"
for name, change, says in (
    ("an entry of nan", set_entry("term0.reflectance", np.nan), NOT_FINITE),
    ("an entry of inf", set_entry("term0.reflectance", np.inf), NOT_FINITE),
    ("an entry of 7", set_entry("term0.reflectance", 7.0), NOT_SYMMETRIC),
    (
        "a variance of nan",
        set_entry("term0.variance", np.nan),
        "variance: holds values that are not finite",
    ),
    (
        "a variance below 0",
        set_item("term0.variance", -np.ones((1, COUNT, COUNT), np.float32)),
        "global.variance: holds values below 0",
    ),
    ("vertices that are not finite", set_item("vertices", np.full((COUNT, 3), np.nan)), VERTICES),
    ("vertices all in one place", set_item("vertices", np.zeros((COUNT, 3))), "a vertex has no area around it"),
    ("faces that name no vertex", set_item("faces", np.full((80, 3), 99)), "faces and vertices do not fit"),
    ("no faces", set_item("faces", np.zeros((0, 3), np.int64)), FACES),
    ("faces of two corners", set_item("faces", np.zeros((80, 2), np.int64)), FACES),
    ("text for entries", set_item("term0.reflectance", np.full((1, COUNT, COUNT), "x")), "reflectance: holds <U1"),
    ("one number for entries", set_item("term0.reflectance", np.array(1.0)), "reflectance: has no axis of lasers"),
):
    FAMILY.case(f"a model's file with {name}", f"refused: {says}", "damage", ends=Ends.REFUSED, says=says)(
        partial(model_file, change)
    )
FAMILY.case(
    "a model's file with an albedo below 0",
    "refused: lambertian.albedo: holds values below 0",
    "1 of 42 values",
    ends=Ends.REFUSED,
    says="lambertian.albedo: holds values below 0",
)(
    lambda: model_file(
        lambda arrays: arrays["term0.albedo"].__setitem__((0, 3), -0.5),
        RelightableModel(MESH, Boundary(1.3), (LambertianTerm(np.ones((1, COUNT), np.float32)),)),
    )
)


def record_off(kind: str) -> float:
    """Pixels that come back changed."""
    rng = np.random.default_rng(1)
    charge = {
        "all 0": np.zeros((37, 53)),
        "all full": np.full((37, 53), 65535),
        "one pixel": np.array([[65535]]),
        "0 and full by turns": 65535 * (np.arange(37 * 53).reshape(37, 53) % 2),
        "noise over 16 bits": rng.integers(0, 65536, (37, 53)),
    }[kind].astype(np.uint16)
    exponent = rng.integers(0, 256, charge.shape, dtype=np.uint8)
    back = decode(charge.shape, *encode(RawImage(exponent, charge)))
    return float((back.charge != charge).sum() + (back.exponent != exponent).sum())


for kind in ("all 0", "all full", "one pixel", "0 and full by turns", "noise over 16 bits"):
    FAMILY.case(f"a record, {kind}", "the same pixels", "16 bits, exponents 0 .. 255")(partial(record_off, kind))
