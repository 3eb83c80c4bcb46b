"""The viewer in a headless Chromium: while ns-train trains, and on an extracted run."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from places import SUPPORT
from run_folders import write_drawn_scene, write_prepared, write_scene, write_trained

pytest.importorskip("nerfstudio")

from browser import NEEDED, Page
from viewer_pages import HEIGHT, WIDTH, awaited, differing, free_port, painted, picture, started, varied, viewed
from written_splats import read_ply

from beags_plugin.objects.extract import extract_objects
from beags_plugin.splat_io.ply import write_ply

pytestmark = [NEEDED, pytest.mark.slow("a browser watches whole trainings")]
STEPS = 60, 240  # Steps of base and refinement.


def step_of(page: Page) -> int:
    """Return the training step that the page shows."""
    found = re.search(r"Step: (\d+)", page.text())
    return int(found[1]) if found else -1


def test_a_training_is_watched_and_goes_on_to_its_end(tmp_path):
    """Both phases: the page opens, outputs change, an object is hidden; the run ends as it should."""
    data, run, seen, port = tmp_path / "lab", tmp_path / "run", tmp_path / "seen", free_port()
    seen.mkdir()
    write_ply(tmp_path / "scene.ply", write_drawn_scene(data))
    command = (
        SUPPORT / "watched_training.py", seen, "beags-refine", "--data", data, "--run-dir", run,
        "--machine.device-type", "cpu", "--vis", "viewer+tensorboard", "--viewer.websocket-port", port,
        "--pipeline.model.start-from", tmp_path / "scene.ply", "--pipeline.model.prepare.k", 10,
        "--pipeline.model.base-steps", STEPS[0], "--pipeline.model.refine-steps", STEPS[1],
        "beags-data", "--orientation-method", "none",
    )  # fmt: skip
    with (
        started(list(command), tmp_path / "log.txt", "Viewer running locally") as process,
        Page(f"http://127.0.0.1:{port}", WIDTH, HEIGHT) as page,
    ):
        page.wait_for_text("Export what is shown", 300)
        page.wait_for_text("No objects: the Gaussians have no classes yet")
        whole = awaited(page, lambda now: varied(now) > 2)
        page.choose("Output type", "depth")
        awaited(page, lambda now: differing(now, whole) > 0.002 and varied(now) > 2)
        page.wait(lambda: 0 <= step_of(page) < STEPS[0])
        page.press("Export what is shown")  # The run has no checkpoint yet.
        page.wait_for_text("Exported to")
        assert process.poll() is None
        (seen / "base").touch()
        page.wait(lambda: step_of(page) > STEPS[0], 300)
        page.choose("Output type", "class_map")
        page.wait(lambda: painted(picture(page), "cup") > 0.01 < painted(picture(page), "box"))
        page.choose("Object", "cup")
        awaited(page, lambda now: painted(now, "cup") < 0.001 and painted(now, "box") > 0.01, "Hide")
        awaited(page, lambda now: painted(now, "cup") > 0.01 < painted(now, "box"), "Show all objects")
        assert process.poll() is None and not (run / "training.json").exists()
        (seen / "refine").touch()
        assert process.wait(300) == 0
    report = json.loads((run / "training.json").read_text())
    assert report["seconds"]["refinement"] > 0
    (checkpoint,) = (run / "nerfstudio_models").iterdir()
    assert checkpoint.name == f"step-{sum(STEPS) - 1:09d}.ckpt"


def test_an_extracted_run_is_looked_at(tmp_path):
    """Its object alone, the masks of the run that it is from, and an export of it."""
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"), scale=0.1)
    write_prepared(tmp_path / "run", shift=1, scale=0.1)
    (extracted,) = extract_objects(config, ["cup"], keep_all=True)  # the masks are not those of the discs
    with viewed(extracted.config, tmp_path / "log.txt") as address, Page(address, WIDTH, HEIGHT) as page:
        page.wait_for_text("Export what is shown", 200)
        assert page.chosen("Object") == "cup" and "box" not in page.text()
        page.choose("Output type", "class_map")
        alone = awaited(page, lambda now: painted(now, "cup") > 0.01)
        assert painted(alone, "box") == 0.0
        page.choose("Output type", "mask_after")
        awaited(page, lambda now: painted(now, "cup") > 0.01 < painted(now, "box"))
        page.choose("Output type", "rgb")
        whole = awaited(page, lambda now: varied(now) > 2 and differing(now, alone) > 0.002)
        awaited(page, lambda now: varied(now) < 1 and differing(now, whole) > 0.002, "Hide")
        awaited(page, lambda now: differing(now, whole) < 0.002, "Show all objects")
        page.press("Export what is shown")
        page.wait_for_text("Exported to")
    surfels, classes = read_ply(extracted.config.parent / "exports/shown_scene.ply")
    assert len(surfels) == 25 and classes is not None and set(np.unique(classes).tolist()) == {1}
