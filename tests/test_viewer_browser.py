"""ns-viewer as a user sees it: the real command, in a headless Chromium."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from run_folders import CLASSES, write_prepared, write_scene, write_trained

pytest.importorskip("nerfstudio")

from browser import Page, chromium

from beags_plugin.extraction.ply import read_ply
from beags_plugin.masks.classes import colorize

pytestmark = pytest.mark.skipif(chromium() is None, reason="there is no chromium (Debian: apt-get install chromium)")
ENTRY = "from nerfstudio.scripts.viewer.run_viewer import entrypoint; entrypoint()"  # what ns-viewer runs


WIDTH, HEIGHT = 640, 400
COLORS = {name: colorize(np.array([[index]]))[0, 0].astype(int) for index, name in CLASSES.items()}
OUTPUTS = (
    "rgb", "depth", "normal", "accumulation", "class_map", "class_confidence", "boundary_error", "occupancy_violation",
    "mask_before", "mask_after",
)  # fmt: skip


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """The config.yml of a run, the address of its viewer, and the file that the viewer prints to.

    The scene is so small that all of it is seen from where the viewer's camera is at first.
    """
    root = tmp_path_factory.mktemp("served")
    config = write_trained(root / "run", write_scene(root / "lab"), scale=0.1)
    write_prepared(root / "run", shift=1, scale=0.1)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    log = root / "log.txt"
    options = ("--load-config", config, "--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port", port)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path[1:]])}
    with open(log, "wb") as out:
        process = subprocess.Popen(
            [sys.executable, "-c", ENTRY, *map(str, options)], stdout=out, stderr=subprocess.STDOUT, env=environment
        )
    end = time.monotonic() + 500
    while "disabled local writer" not in log.read_text():  # the last that it prints
        assert process.poll() is None and time.monotonic() < end, log.read_text()[-3000:]
        time.sleep(0.5)
    yield config, f"http://127.0.0.1:{port}", log
    process.terminate()
    process.wait()
    assert "Traceback" not in log.read_text()


@pytest.fixture(scope="module")
def opened(served):
    """One page for all tests: a browser that draws without a GPU is slow to start."""
    with Page(served[1], WIDTH, HEIGHT) as page:
        page.wait_for_text("Export what is shown", 200)
        yield page


@pytest.fixture
def page(opened):
    """As it is when it opens."""
    opened.press("Show all objects")
    for label in ("Rest", "Least opacity"):
        opened.slide(label, 0)
    return opened


def picture(page: Page) -> np.ndarray:
    """What is left of the panel and below the title, without the cross of axes in the corner; [H, W, 3] int."""
    pixels = np.asarray(Image.open(BytesIO(page.picture())).convert("RGB"))
    return pixels[60:340, :310].astype(int)


def differing(one: np.ndarray, other: np.ndarray) -> float:
    """Share of the pixels that differ by more than what JPEG does to them."""
    return float((np.abs(one - other).max(axis=2) > 40).mean())


def varied(pixels: np.ndarray) -> float:
    """How much a picture varies over its pixels; 0 for one colour."""
    return float(pixels.reshape(-1, 3).std(axis=0).max())


def painted(pixels: np.ndarray, name: str) -> float:
    """Share of the pixels that have the colour of a class."""
    return float((np.abs(pixels - np.array(COLORS[name])).max(axis=2) < 30).mean())


def awaited(page: Page, true) -> np.ndarray:
    """The picture, once it is as asked for and stays so: coarse ones come before it."""
    found = [picture(page)]

    def holds() -> bool:
        found.append(picture(page))
        return differing(*found[-2:]) == 0.0 and true(found[-1])

    page.wait(holds, 120)
    return found[-1]


def test_every_output_is_a_picture_of_its_own(page):
    assert all(name in page.text() for name in (*CLASSES.values(), "Least opacity"))
    seen: dict[str, np.ndarray] = {}
    for output in OUTPUTS:
        page.choose("Output type", output)
        seen[output] = awaited(
            page,
            lambda now: varied(now) > 2 and all(differing(now, other) > 0.002 for other in seen.values()),
        )
    assert painted(seen["class_map"], "cup") > 0.01 < painted(seen["class_map"], "box")
    assert painted(seen["mask_before"], "cup") > 0.01 < painted(seen["mask_after"], "cup")


def test_objects_are_isolated_hidden_faded_and_removed(page):
    page.choose("Output type", "class_map")
    whole = awaited(page, lambda now: painted(now, "cup") > 0.01 < painted(now, "box"))
    page.choose("Object", "cup")

    def struck() -> str:
        return page.evaluate("[...document.querySelectorAll('del')].map(e => e.innerText).join()")

    page.press("Isolate")
    awaited(page, lambda now: painted(now, "box") < 0.001 and painted(now, "cup") > 0.9 * painted(whole, "cup"))
    page.wait(lambda: struck() == "background,box")
    page.press("Show all objects")
    awaited(page, lambda now: painted(now, "box") > 0.01)
    page.press("Hide")
    awaited(page, lambda now: painted(now, "cup") < 0.001 and painted(now, "box") > 0.01)
    page.slide("Rest", 0.5)
    awaited(page, lambda now: painted(now, "cup") > 0.01)
    page.press("Remove")
    awaited(page, lambda now: painted(now, "cup") < 0.001 and painted(now, "box") > 0.01)
    page.wait(lambda: struck() == "cup")


def test_the_sliders_fade_and_thin_out(page):
    """The discs have an opacity of 0.95."""
    page.choose("Output type", "accumulation")
    whole = awaited(page, lambda now: varied(now) > 2)
    page.slide("Least opacity", 0.97)
    awaited(page, lambda now: varied(now) < 1)
    page.slide("Least opacity", 0.9)
    awaited(page, lambda now: differing(now, whole) < 0.002)
    page.choose("Object", "box")
    page.press("Isolate")
    alone = awaited(page, lambda now: differing(now, whole) > 0.01)
    page.slide("Rest", 0.2)
    awaited(page, lambda now: differing(now, whole) > 0.01 < differing(now, alone))


def test_a_click_picks_what_is_under_the_cursor(page):
    page.choose("Output type", "class_map")
    seen = awaited(page, lambda now: painted(now, "cup") > 0.01 < painted(now, "box"))
    for name in ("box", "cup"):
        rows, columns = (np.abs(seen - np.array(COLORS[name])).max(axis=2) < 30).nonzero()
        page.click(float(np.median(columns)), 60 + float(np.median(rows)))
        page.wait_for_text(f"Picked: {name}")
        assert page.chosen("Object") == name
    page.click(20, 70)
    page.wait_for_text("Nothing is shown there.")


def test_what_is_shown_is_exported(page, served):
    page.choose("Object", "cup")
    page.press("Isolate")
    page.press("Export what is shown")
    page.wait_for_text("Exported to")
    surfels, classes = read_ply(served[0].parent / "exports/shown_cup.ply")
    assert len(surfels) == 25 and set(classes.tolist()) == {1}
