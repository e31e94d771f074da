"""`disco-twin view` on a run from a known R_d: the page in headless Chromium, number by number; and what it refuses."""

from __future__ import annotations

import base64
import io
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from frozen_run import write_frozen_run
from PIL import Image
from view_models import model_on

from disco_twin.cli.app import main
from disco_twin.evaluate.opened_run import OpenedRun
from disco_twin.evaluate.scores import score_run
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.view import page as page_module
from disco_twin.view.page import write_page
from hw.base.errors import InputError
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.mesh import RayMesh

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
READ = """([light, view]) => {
  const numbers = view === null ? discoTwin.radiosity(light).flatMap((own) => Array.from(own))
    : discoTwin.image(light, view).radiance;
  return btoa(Array.from(new Uint8Array(Float32Array.from(numbers).buffer), (x) => String.fromCharCode(x)).join(""));
}"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A scored run whose model has directions and a measured boundary."""
    root = tmp_path_factory.mktemp("view") / "run"
    write_frozen_run(root)
    run = OpenedRun(root)
    model_on(run.experiment.scan).save(run.folder.work / "model-lambertian.npz")
    score_run(run.experiment, run.folder, ("lambertian",))
    run.folder.run("scores", "frozen", lambda: None)
    return run.folder


@pytest.fixture(scope="module")
def page(folder: RunFolder) -> Path:
    main_view(folder)
    return folder.view_file


def main_view(folder: RunFolder, *options: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["view", str(folder.root), *options])
    assert ended.value.code == 0


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """Starts Chromium with these arguments more; skipped where there is none."""
    if CHROMIUM is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    driver = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install disco-twin[browser]")
    with driver.sync_playwright() as playwright:
        yield lambda *more: playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *more])


@pytest.fixture(scope="module")
def opened(chromium: Any, page: Path) -> Iterator[Any]:
    """The page in a window of 1024 pixels; `wrong` collects what its scripts complain of."""
    browser = chromium(*SOFTWARE_GL)
    tab = browser.new_page(viewport={"width": 1024, "height": 768})
    tab.wrong, tab.asked = [], []
    tab.on("pageerror", lambda error: tab.wrong.append(str(error)))
    tab.on("request", lambda request: tab.asked.append(request.url))
    tab.goto(page.as_uri())
    assert tab.evaluate("discoTwin.ready") == ""
    yield tab
    browser.close()


def numbers(tab: Any, light: int, view: int | None) -> np.ndarray:
    assert not tab.evaluate("discoTwin.app.painter.gl.isContextLost()")
    return np.frombuffer(base64.b64decode(tab.evaluate(READ, [light, view])), np.float32).astype(float)


def test_the_page_is_one_file_without_network(page: Path, opened: Any) -> None:
    assert opened.asked == [page.as_uri()] or all(
        url.startswith(("data:", "blob:", page.as_uri())) for url in opened.asked
    )
    assert page.stat().st_size < 1e6
    assert "http" not in page.read_text().replace("http://www.w3.org", "")


def test_numbers_are_the_pipeline_s_within_a_percent(opened: Any, folder: RunFolder) -> None:
    """On vertices and in pixels, against the dense model's own relighting."""
    scene = folder.read_scene()
    model = OpenedRun(folder.root).models["lambertian"]
    area, points = RayMesh.of(model.mesh).vertex_areas, np.asarray(model.mesh.vertices, np.float64)
    for number, light in enumerate(scene.relight.lights):
        lit = model.lit_by(light)
        exact = model.terms[0].radiosity(lit.tilted_flux, points)  # type: ignore[attr-defined]
        own = np.moveaxis(numbers(opened, number, None).reshape(2, -1, 4), -1, 0)
        assert ((own[0] - exact[0]) ** 2 @ area).sum() < 1e-4 * (exact[0] ** 2 @ area).sum()
        for k, view in enumerate(scene.relight.views):
            image = model.image(lit, model.seen_by(PinholeCamera.from_config(view)))
            drawn = numbers(opened, number, k).reshape(view.height, view.width, 4)
            assert np.linalg.norm(drawn[..., :2] - image.transpose(1, 2, 0)) < 0.01 * np.linalg.norm(image)
            assert ((drawn[..., 3] > 0) != (image[0] > 0)).mean() < 0.01  # the outline's own rounding


def seen(tab: Any) -> np.ndarray:
    """(H, W, 3) the stage as it is on the screen."""
    tab.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return np.asarray(Image.open(io.BytesIO(tab.locator("#stage").screenshot())).convert("RGB"), float)


def test_what_hands_do_shows(opened: Any) -> None:
    """Every one of these changes the picture; nothing of it is blank, nothing complains."""
    before = seen(opened)
    assert before.std() > 20
    for act in ("2", "[", "f", "ArrowLeft", "l", "ArrowDown", "c", "c", "o"):
        opened.keyboard.press(act)
        after = seen(opened)
        assert after.std() > 10
        if act not in ("l", "o"):
            assert np.abs(after - before).mean() > 0.3, act
        before = after
    opened.get_by_role("button", name="As shipped").click()
    box = opened.locator("#canvas").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    opened.mouse.move(*middle)
    opened.keyboard.down("Shift")
    opened.mouse.down()
    opened.mouse.move(middle[0] + 40, middle[1] + 30)
    opened.mouse.up()
    opened.keyboard.up("Shift")
    opened.wait_for_function("document.querySelector('#status').textContent.includes('moved')")
    opened.keyboard.press("p")
    opened.mouse.click(*middle)
    assert np.abs(seen(opened) - before).mean() > 1
    assert "Medians" in opened.inner_text("#response") or "Vertex" in opened.inner_text("#response")
    opened.get_by_label("direction of exit").uncheck()
    assert opened.wrong == []


def test_a_lost_context_leaves_the_picture(opened: Any) -> None:
    opened.evaluate("discoTwin.app.painter.gl.getExtension('WEBGL_lose_context').loseContext()")
    opened.wait_for_selector("#sorry:not([hidden])")
    assert "graphics card was lost" in opened.inner_text("#sorry")
    assert opened.evaluate("document.querySelector('#sorry img').naturalWidth") > 100


def test_without_webgl2_there_are_a_sentence_and_a_picture(chromium: Any, page: Path) -> None:
    browser = chromium("--disable-3d-apis")
    tab = browser.new_page()
    tab.goto(page.as_uri())
    assert tab.evaluate("discoTwin.ready") == "no WebGL2"
    assert "needs WebGL2" in tab.inner_text("#sorry")
    assert tab.evaluate("document.querySelector('#sorry img').naturalWidth") > 100
    browser.close()


# ---- what is refused, in one line


def test_refusals(folder: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"--method = 'mine': was not reconstructed here \(allowed: lambertian"):
        write_page(folder, tmp_path / "x.html", "mine")
    monkeypatch.setattr(page_module, "LARGEST_MB", 0.03)
    with pytest.raises(InputError, match=r"--rank = 8: the page would have 0 MB .*Remedy: --rank [1-5]$"):
        write_page(folder, tmp_path / "x.html")
    monkeypatch.undo()
    copy = tmp_path / "copy"
    shutil.copytree(folder.root, copy)
    model = copy / "work" / "model-lambertian.npz"
    with np.load(model) as data:
        np.savez(model, **{name: array for name, array in data.items() if name not in ("vertices", "faces")})
    with pytest.raises(InputError, match=r"model-lambertian.npz: is damaged, or no model .*Remedy"):
        write_page(RunFolder.open(copy), tmp_path / "x.html")
    del (unfinished := RunFolder.open(copy)).stages["scores"]
    with pytest.raises(
        InputError, match=r"the run is unfinished: the stage scores is not done. Remedy: disco-twin run"
    ):
        write_page(unfinished, tmp_path / "x.html")
    assert not (tmp_path / "x.html").exists()
