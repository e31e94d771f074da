"""What the page's own scripts compute, run by Node without a browser, against the pipeline: flux and radiosity."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from view_models import dented, model_on

from disco_twin.view.collect import model_block
from disco_twin.view.pack import Block
from disco_twin.view.page import SCRIPTS
from hw.base.arrays import F64
from pipeline.geometry.mesh import RayMesh
from pipeline.model.factorise import Truncation, factorised
from pipeline.relight.lights import shipped_lights

NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="needs node, which is not installed")
LIGHTS = [x for x in shipped_lights((150.0, 400.0, 110.0)) if x.name in ("uniform", "edge", "projector", "spot")]
RUN = """
const vm = require("vm"), fs = require("fs");
const given = JSON.parse(fs.readFileSync(0, "utf8"));
vm.runInThisContext(given.script + "\\nthis.page = { parseBlock, modelOf, fluxByLaser, FINE, DRAGGED };");
const block = page.parseBlock(Uint8Array.from(Buffer.from(given.block, "base64"))), model = page.modelOf(block);
const text = (numbers) => Buffer.from(Float64Array.from(numbers).buffer).toString("base64");
const out = {};
for (const light of block.head.lights.filter((one) => !given.only || one.name === given.only)) {
  const own = (...how) => page.fluxByLaser(block, model.surface, light, [1, 1], ...how);
  const flux = own(page.FINE), parts = given.parts;
  out[light.name] = { flux: flux.map(text), dragged: own(page.DRAGGED).map(text),
    unshaded: light.kind === "projector" ? own(page.FINE, false).map(text) : [text([0, 0, 0, 0]), text([0, 0, 0, 0])],
    radiosity: flux.map((q, n) => text(model.radiosity(q, n, ...(parts ? [parts] : [])))) };
}
console.log(JSON.stringify(out));
"""


def numeric_script() -> str:
    files = resources.files("disco_twin.view") / "page"
    names = SCRIPTS[: SCRIPTS.index("draw")]  # what follows draws
    return "\n".join((files / f"{name}.js").read_text() for name in names)


def computed(block: bytes, parts: dict[str, bool] | None = None, only: str | None = None) -> dict[str, dict[str, F64]]:
    """By light: flux, flux while it is dragged, and radiosity, (4, L, V) each."""
    given = {"script": numeric_script(), "block": base64.b64encode(block).decode(), "parts": parts}
    given["only"] = only
    assert NODE is not None
    done = subprocess.run([NODE, "-e", RUN], input=json.dumps(given), capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr

    def array(texts: list[str]) -> F64:
        lasers = [np.frombuffer(base64.b64decode(text)).reshape(-1, 4).T for text in texts]
        return np.stack(lasers, axis=1)

    return {
        light: {name: array(own) for name, own in parts.items()} for light, parts in json.loads(done.stdout).items()
    }


MODEL = model_on(dented())
AREA, POINTS = RayMesh.of(MODEL.mesh).vertex_areas, np.asarray(MODEL.mesh.vertices, np.float64)


FAST = factorised(MODEL, Truncation(72, 8, 6))


@pytest.fixture(scope="module")
def block() -> bytes:
    packed, head = model_block(MODEL, FAST, LIGHTS)
    return packed.packed(head)


@pytest.fixture(scope="module")
def numbers(block: bytes) -> dict[str, dict[str, F64]]:
    return computed(block)


def off(one: F64, other: F64) -> float:
    """Relative rms over the surface, all wavelengths."""
    return float(np.sqrt(((one - other) ** 2 * AREA).sum() / (other**2 * AREA).sum()))


@needs_node
@pytest.mark.parametrize("light", LIGHTS, ids=lambda light: light.name)
def test_flux_and_radiosity_are_the_pipeline_s_within_a_percent(numbers: Any, light: Any) -> None:
    """Rationale: another integrator, other rays, half floats and factors, against the dense model's own relighting."""
    own, flux = numbers[light.name], MODEL.lit_by(light).tilted_flux
    exact, fast = (model.terms[0].radiosity(flux, POINTS) for model in (MODEL, FAST))  # type: ignore[attr-defined]
    assert off(own["flux"] / np.sqrt(AREA), flux / np.sqrt(AREA)) < 0.005
    assert off(own["radiosity"][0], exact[0]) < 0.01
    assert off(own["radiosity"][0], fast[0]) < 0.002
    total = np.sqrt((exact[0] ** 2 @ AREA).sum())
    assert np.sqrt(((own["radiosity"][1:] - fast[1:]) ** 2 @ AREA).sum()) < 0.004 * total
    assert off(own["dragged"], own["flux"]) < 0.08


@needs_node
def test_the_object_shades_itself(numbers: Any) -> None:
    own = numbers["projector"]
    assert own["flux"][0].sum() < 0.98 * own["unshaded"][0].sum()


@needs_node
def test_directions_can_be_switched_off(block: bytes, numbers: Any) -> None:
    """Without directions the radiosity is that of the flux alone, and has no moments."""
    plain = computed(block, {"near": True, "far": True, "entry": False, "exit": False}, "spot")["spot"]["radiosity"]
    flux = MODEL.lit_by(LIGHTS[-1]).flux
    exact = np.stack([q @ r for q, r in zip(flux, MODEL.terms[0].arrays()["reflectance"], strict=True)])
    assert off(plain[0], exact) < 0.01
    assert off(plain[0], numbers["spot"]["radiosity"][0]) > 0.02
    assert (plain[1:] == 0).all()


def test_half_floats_keep_three_digits_over_decades() -> None:
    block, values = Block(), np.geomspace(1e-9, 5e3, 40)
    block.half("x", values)
    raw = block.packed({"name": "é"})
    length = int.from_bytes(raw[:4], "little")
    entry = json.loads(raw[4 : 4 + length])["arrays"]["x"]
    back = np.frombuffer(raw, "<f2", 40, entry["at"]).astype(float) * entry["scale"]
    np.testing.assert_allclose(back, values, rtol=1e-3, atol=1e-9 * 5e3)
    assert entry["at"] % 4 == 0
    assert block.text({}) == block.text({})


def test_the_package_holds_its_scripts() -> None:
    folder = Path(str(resources.files("disco_twin.view") / "page"))
    assert {path.stem for path in folder.glob("*.js")} == set(SCRIPTS)
