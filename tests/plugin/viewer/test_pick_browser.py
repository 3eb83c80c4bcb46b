"""Objects are picked in ns-viewer, in a headless Chromium: clicks at pixels of a known scene give the known objects."""

from __future__ import annotations

import json
import re
import shlex

import numpy as np
import pytest
import torch
from solid_runs import write_solids, write_solids_run
from touching_solids import overlap, solids

pytest.importorskip("nerfstudio")

from browser import NEEDED, Page
from viewer_pages import HEIGHT, WIDTH, awaited, differing, picture, varied, viewed
from written_splats import read_ply

from beags_plugin.labels.classes import read_id_mask
from beags_plugin.objects.extract import extract_objects
from beags_plugin.plugin.presets import preset_config

pytestmark = [NEEDED, pytest.mark.slow("a browser clicks through a pick by WebGL in software")]
RED, BLUE = (0, 1, 2), (2, 0, 1)  # channels of the low and the high block, the strongest first


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """Yield config.yml and owners of a run without classes or masks, and a page of its viewer with the tab open."""
    root = tmp_path_factory.mktemp("picked")
    config, owner = write_solids_run(root / "run", write_solids(root / "lab"))
    with viewed(config, root / "log.txt") as address, Page(address, WIDTH, HEIGHT) as page:
        page.open_tab("Pick")
        whole = awaited(page, lambda now: varied(now) > 2)
        page.drag((160, 300), (170, 300))  # the first picture may be that of a page of another size
        awaited(page, lambda now: varied(now) > 2 and differing(now, whole) > 0.002)
        page.tick("Click to pick")
        yield config, owner, page


def coloured(seen: np.ndarray, channels: tuple[int, int, int]) -> np.ndarray:
    """Return which pixels have the colour of a block that is not picked, [H, W] bool."""
    return seen[..., channels[0]] > 1.6 * np.maximum(seen[..., channels[1]], seen[..., channels[2]])


def middle_of(page: Page, channels: tuple[int, int, int]) -> tuple[float, float]:
    """Return the middle of a block, in pixels of the page."""
    rows, columns = coloured(picture(page), channels).nonzero()
    assert len(rows) > 200
    return float(np.median(columns)), 60 + float(np.median(rows))


def summary(page: Page, name: str, after: str = "") -> int:
    """Return the number of Gaussians that the panel gives for an object, once it does and no longer reads ``after``."""
    page.wait(lambda: re.search(rf"{name}: [\d,]+ Gaussians", page.text()) and (not after or after not in page.text()))
    return int(re.search(rf"{name}: ([\d,]+) Gaussians", page.text())[1].replace(",", ""))


def marked(seen: np.ndarray) -> float:
    """Return the share of the pixels that are about as pink as the tab Size's points and line."""
    return float((np.minimum(seen[..., 0], seen[..., 2]) - seen[..., 1] > 60).mean())


def test_the_first_moment_shows_the_scene_and_a_click_on_a_camera_is_told(served):
    """The page begins where the first training camera stands, whose photo would cover the scene and take all clicks."""
    with Page(served[2].evaluate("location.href"), WIDTH, HEIGHT) as page:
        page.open_tab("Pick")
        text = page.wait_for_text("Show Train Cams")
        assert "Hide Train Cams" not in text
        for word in ("Training", "Train Util", "Train Speed", "NerfStudio"):
            assert word not in text
        page.wait(lambda: "Canvas of this page" not in page.text())
        awaited(page, lambda now: varied(now) > 2)  # Viser ignores what a page sends before its first camera.
        assert page.evaluate("document.querySelectorAll('img[src^=http]').length") == 0
        page.press("Show Train Cams")
        page.wait_for_text("Hide Train Cams")
        page.wait(lambda: page.click(160, 200) or "The click hit the training camera of v" in page.text())
        page.press("Hide Train Cams")
        page.wait_for_text("Show Train Cams")


def test_a_length_between_two_clicks_gives_the_export_its_size(served):
    config, _, page = served
    page.open_tab("Size")
    page.tick("Click two points")
    enough = marked(picture(page)) + 0.0001  # Pixels between a red and a blue block are pink too.
    page.click(*middle_of(page, RED))
    page.wait_for_text("B is missing")
    first = awaited(page, lambda now: marked(now) > enough)
    page.drag((100, 200), (130, 210))  # turns the camera, and measures nothing
    turned = awaited(page, lambda now: differing(now, first) > 0.01)
    page.drag((130, 210), (100, 200))
    awaited(page, lambda now: differing(now, turned) > 0.01)
    page.click(*middle_of(page, BLUE))
    page.wait_for_text("The length from A to B is missing")
    page.write("Length", "12 parsecs")
    page.wait_for_text("is no length")
    page.write("Length", "12 cm")
    page.wait_for_text("--scale-by")
    places = re.search(r'--scale-by "(\S+) (\S+) 12 cm"', page.text())
    assert places is not None
    points = np.array([[float(x) for x in place.split(",")] for place in places.groups()])
    surfels, owner = solids(dict.fromkeys(range(3), (0.5,) * 3))
    for point, block in zip(points, (1, 2), strict=True):
        assert np.linalg.norm(surfels.means[owner == block].numpy() - point, axis=1).min() < 0.05
    awaited(page, lambda now: marked(now) > 1.5 * marked(first))
    page.open_tab("Control")
    page.press("Export what is shown")
    page.wait_for_text("to scale.")
    (file,) = (config.parent / "exports").glob("shown_*.ply")
    size = 0.12 / np.linalg.norm(points[0] - points[1])
    assert torch.allclose(read_ply(file)[0].means, size * surfels.means, rtol=1e-3, atol=1e-4)
    page.open_tab("Size")
    page.press("Without a size")
    page.wait_for_text("Tick Click two points")
    awaited(page, lambda now: marked(now) < (enough + marked(first)) / 2)
    page.open_tab("Pick")
    page.tick("Click to pick")  # It was ticked before.


def test_objects_are_picked_saved_refined_and_kept(served):
    config, owner, page = served
    run, lab = config.parent, config.parent.parent / "lab"
    whole = picture(page)
    red, blue = middle_of(page, RED), middle_of(page, BLUE)

    page.click(*red)
    low = summary(page, "object 1")
    painted = awaited(page, lambda now: differing(now, whole) > 0.01)
    page.press("Export the picked object")
    page.wait_for_text("Exported to")
    (file,) = (run / "exports").glob("picked_*.ply")
    means = torch.cdist(read_ply(file)[0].means.double(), solids(dict.fromkeys(range(3), (0.5,) * 3))[0].means.double())
    found = torch.zeros(len(owner), dtype=torch.bool)
    found[means.argmin(dim=1)] = True
    assert len(means) == low and overlap(found, owner == 1) > 0.95

    page.tick("Exclude")
    page.click(*red)
    page.wait_for_text("contradicts another point")
    page.wait_for_text("Nothing has been changed")
    page.tick("Exclude")
    page.write("Name", "low")
    page.wait(lambda: page.chosen("Picked") == "low")
    page.drag((100, 200), (130, 210))  # turns the camera, and picks nothing
    turned = awaited(page, lambda now: differing(now, painted) > 0.01)
    whole_blue = coloured(turned, BLUE).sum()
    blue = middle_of(page, BLUE)

    page.press("Another object")
    page.wait(lambda: page.chosen("Picked") == "object 1")
    page.press("Drag a box")
    page.wait_for_text("Drag a box over the picture")
    rows, columns = coloured(turned, BLUE).nonzero()  # a wider box would take in the ground beside the block
    page.drag((columns.min() - 2, 58 + rows.min()), (columns.max() + 2, 62 + rows.max()))
    boxed = summary(page, "object 1")
    page.press("Undo")
    page.wait_for_text("object 1: nothing yet")
    page.click(*blue)
    high = summary(page, "object 1", "nothing yet")
    assert 0.2 * high < boxed <= high
    awaited(page, lambda now: coloured(now, BLUE).sum() < 0.2 * whole_blue)
    page.press("Undo")
    page.wait_for_text("object 1: nothing yet")
    awaited(page, lambda now: coloured(now, BLUE).sum() > 0.9 * whole_blue)
    page.click(*blue)
    assert summary(page, "object 1", "nothing yet") == high
    page.write("Name", "high")
    page.wait(lambda: page.chosen("Picked") == "high")
    page.tick("Only what is picked")
    assert (turned.min(axis=2) > 100).mean() > 0.1  # the floor is grey
    awaited(page, lambda now: varied(now) > 2 and (now.min(axis=2) > 100).mean() < 0.01)
    page.tick("Only what is picked")

    page.press("Save as masks")
    page.wait_for_text("Saved ", 300)
    page.wait_for_text("ns-train beags-refine")
    wide = (
        "[...document.querySelectorAll('pre, p, div')].filter(e => e.innerText?.includes('beags-refine')"
        f" && e.scrollWidth > e.clientWidth + 1 && 0 < e.clientWidth && e.clientWidth <= {WIDTH // 2}).length"
    )
    assert page.evaluate(wide) == 0  # no text runs off the panel
    copied = page.evaluate("[...document.querySelectorAll('pre')].find(e => e.innerText.includes('refine')).innerText")
    assert {"ns-train", "--masks-path", str(run / "picked/masks")} <= set(shlex.split(copied))
    assert not (lab / "masks").exists()
    saved = run / "picked"
    names = json.loads((saved / "classes.json").read_text())
    assert sorted(names.values()) == ["background", "high", "low"]
    masks = sorted((saved / "masks").glob("*.png"))
    assert masks and set(np.concatenate([np.unique(read_id_mask(path)) for path in masks])) == {0, 1, 2}

    page.press("Keep in the run")
    page.wait_for_text("Kept in")
    page.open_tab("Control")
    page.choose("Object", "low")
    (extracted,) = extract_objects(config, ["low"], keep_all=True)
    assert extracted.gaussians == low

    refine = preset_config("beags-refine", {"vis": "tensorboard", "pipeline.model.refine_steps": 5}, run.parent / "new")
    refine.data_config.data, refine.load_dir = lab, run / "nerfstudio_models"
    parser = refine.data_config.dataparser
    parser.masks_path, parser.classes_path = saved / "masks", saved / "classes.json"
    parser.orientation_method, parser.center_method = "none", "none"  # The run has these too.
    parser.auto_scale_poses, parser.scale_factor = False, 1.0
    refine.machine.device_type = "cpu"
    refine.run_dir = run.parent / "new"
    refine.save_config()
    trainer = refine.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.train()
    (extracted,) = extract_objects(run.parent / "new/config.yml", ["low"], keep_all=True)
    assert extracted.gaussians > 0.8 * low
