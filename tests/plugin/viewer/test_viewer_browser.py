"""ns-viewer as a user sees it: the real command, in a headless Chromium."""

from __future__ import annotations

import numpy as np
import pytest
from run_folders import CLASSES, write_prepared, write_scene, write_trained

pytest.importorskip("nerfstudio")

from browser import NEEDED, Page
from viewer_pages import COLORS, HEIGHT, WIDTH, awaited, differing, painted, slid, varied, viewed
from written_splats import read_ply

pytestmark = [NEEDED, pytest.mark.slow("a browser draws a dozen views of a run by WebGL in software")]
OUTPUTS = (
    "rgb", "depth", "normal", "accumulation", "class_map", "class_confidence", "boundary_error", "mask_before",
    "mask_after",
)  # fmt: skip


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """Yield the config.yml of a run, and the address of its viewer.

    The scene is so small that the viewer's first camera sees all of it.
    """
    root = tmp_path_factory.mktemp("served")
    config = write_trained(root / "run", write_scene(root / "lab"), scale=0.1)
    write_prepared(root / "run", shift=1, scale=0.1)
    with viewed(config, root / "log.txt") as address:
        yield config, address


@pytest.fixture(scope="module")
def opened(served):
    """Yield one page for all tests: a browser without a GPU is slow to start."""
    with Page(served[1], WIDTH, HEIGHT) as page:
        page.wait_for_text("Export what is shown", 200)
        yield page


@pytest.fixture
def page(opened):
    """Return the page as it is when it opens."""
    opened.press("Show all objects")
    for label in ("Rest", "Least opacity"):
        opened.slide(label, 0)
    return opened


def struck(page: Page) -> str:
    """Return the struck-out names of the legend."""
    return page.evaluate("[...document.querySelectorAll('del')].map(e => e.innerText).join()")


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
    awaited(
        page, lambda now: painted(now, "box") < 0.001 and painted(now, "cup") > 0.9 * painted(whole, "cup"), "Isolate"
    )
    page.wait(lambda: struck(page) == "background,box")
    awaited(page, lambda now: painted(now, "box") > 0.01, "Show all objects")
    awaited(page, lambda now: painted(now, "cup") < 0.001 and painted(now, "box") > 0.01, "Hide")
    slid(page, "Rest", 0.5, lambda now: painted(now, "cup") > 0.01)
    awaited(page, lambda now: painted(now, "cup") < 0.001 and painted(now, "box") > 0.01, "Remove")
    page.wait(lambda: struck(page) == "cup")


def test_the_sliders_fade_and_thin_out(page):
    """The discs have an opacity of 0.95."""
    page.choose("Output type", "class_map")
    classes = awaited(page, lambda now: painted(now, "cup") > 0.01 < painted(now, "box"))
    page.choose("Output type", "accumulation")
    # The picture is no longer the one before.
    whole = awaited(page, lambda now: differing(now, classes) > 0.01 and varied(now) > 2)
    empty = slid(page, "Least opacity", 0.97, lambda now: varied(now) < 1)
    slid(page, "Least opacity", 0.9, lambda now: differing(now, whole) < 0.1 * differing(empty, whole))
    page.choose("Object", "box")
    alone = awaited(page, lambda now: differing(now, whole) > 0.01, "Isolate")
    slid(page, "Rest", 0.2, lambda now: differing(now, whole) > 0.01 < differing(now, alone))


def middle_of(seen: np.ndarray, name: str) -> tuple[float, float]:
    """Return the middle of what has a class's colour, in pixels of the page."""
    rows, columns = (np.abs(seen - np.array(COLORS[name])).max(axis=2) < 30).nonzero()
    return float(np.median(columns)), 60 + float(np.median(rows))


def test_the_mouse_turns_the_camera_and_picks_when_asked_to(page):
    """Either button of the mouse turns or moves, as shipped; the pick takes one click; then the mouse turns again."""
    page.choose("Output type", "class_map")
    seen = awaited(page, lambda now: painted(now, "cup") > 0.01 < painted(now, "box"))
    for name in ("box", "cup"):
        page.press("Pick with the next click")
        page.wait_for_text("Click an object in the picture")
        page.click(*middle_of(seen, name))
        page.wait_for_text(f"Picked: {name}")
        assert page.chosen("Object") == name
        for button, to in (("left", (200, 230)), ("right", (140, 230)), ("right", (180, 200)), ("left", (120, 170))):
            page.drag((160, 200), to, button)
            seen = awaited(page, lambda now, before=seen: differing(now, before) > 0.01)
        assert f"Picked: {name}" in page.text()  # a drag is no click
    page.press("Pick with the next click")
    page.wait_for_text("Click an object in the picture")
    page.press("Pick with the next click")  # nothing is picked
    page.wait(lambda: "Click an object" not in page.text())
    page.choose("Object", "box")
    page.press("Centre on this object")
    x, y = middle_of(awaited(page, lambda now: differing(now, seen) > 0.01 and painted(now, "box") > 0.1), "box")
    assert abs(x - 160) < 40 and abs(y - 225) < 40


def test_the_whole_panel_is_seen_at_a_height_of_900(page):
    page.resize(1280, 900)
    page.wait(lambda: 0 < page.bottom("Export what is shown") < 900)
    page.resize(WIDTH, HEIGHT)


def test_what_is_shown_is_exported(page, served):
    page.choose("Object", "cup")
    page.press("Isolate")
    page.wait(lambda: struck(page) == "background,box")  # buttons are heard in threads of their own
    page.press("Export what is shown")
    page.wait_for_text("Exported to")
    surfels, classes = read_ply(served[0].parent / "exports/shown_cup.ply")
    assert len(surfels) == 25 and set(classes.tolist()) == {1}
