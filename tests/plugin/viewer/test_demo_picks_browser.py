"""``beags demo --pick`` whole, in a headless Chromium: clicks in the viewer that it opens, and what comes out.

The base is written, not trained; its refinement is a short one.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from solid_runs import write_solids, write_solids_run
from touching_solids import solids

pytest.importorskip("nerfstudio")

from browser import NEEDED, Page
from places import ROOT
from test_pick_browser import BLUE, RED, middle_of, summary
from viewer_pages import HEIGHT, WIDTH, awaited, free_port, varied
from written_splats import read_ply

from beags_plugin.commands import demo, demo_picks, demo_training
from beags_plugin.plugin.presets import preset_config

pytestmark = [NEEDED, pytest.mark.slow("a browser clicks through a pick by WebGL in software")]


def refine(data: Path, words: list[str]) -> None:
    """Train what ns-train with these words would, for five steps and in the frame of the base."""

    def value(option: str) -> Path:
        return Path(words[words.index(option) + 1])

    assert value("--pipeline.model.base-steps") == Path("0")
    steps = {"vis": "tensorboard", "pipeline.model.base_steps": 0, "pipeline.model.refine_steps": 5}
    config = preset_config(words[1], steps, data)
    config.data_config.data, config.load_dir, config.run_dir = data, value("--load-dir"), value("--run-dir")
    parser = config.data_config.dataparser
    parser.masks_path, parser.classes_path = value("--masks-path"), value("--classes-path")
    parser.orientation_method, parser.center_method = "none", "none"
    parser.auto_scale_poses, parser.scale_factor = False, 1.0
    config.machine.device_type = "cpu"
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.train()


def test_clicks_in_the_viewer_that_the_demo_opens_give_named_objects(tmp_path, monkeypatch, capsys):
    data, output, log = write_solids(tmp_path / "blocks"), tmp_path / "out", tmp_path / "log.txt"
    port, failed = free_port(), []

    def train(words: list[str]) -> None:
        run = Path(words[words.index("--run-dir") + 1])
        if "--load-dir" not in words:
            write_solids_run(run, data)
            (run / "training.json").write_text(json.dumps({"seconds": {"base training": 3.0}}))
            return
        refine(data, words)

    def view(words: list[str], env: dict[str, str]) -> SimpleNamespace:
        path = os.pathsep.join([str(ROOT), *sys.path[1:]])
        with log.open("wb") as out:
            process = subprocess.Popen(
                [*words, "--port", str(port)], stdout=out, stderr=subprocess.STDOUT, env={**env, "PYTHONPATH": path}
            )
        clicking = threading.Thread(target=click, args=(process,))
        clicking.start()
        process.wait()
        clicking.join()
        return SimpleNamespace(returncode=process.returncode)

    def until(text: str) -> None:
        end = time.monotonic() + 300
        while text not in " ".join(log.read_text().split()):
            assert time.monotonic() < end, log.read_text()[-3000:]
            time.sleep(0.2)

    def click(process: subprocess.Popen) -> None:
        try:
            until("disabled local writer")
            address = f"http://127.0.0.1:{port}"
            with Page(address, WIDTH, HEIGHT) as page:
                page.wait_for_text("Click on the first of 2 objects")
            until("The page is closed and nothing is saved yet")
            with Page(address, WIDTH, HEIGHT) as page:
                page.wait_for_text("Save as masks")  # the tab Pick is the first
                awaited(page, lambda now: varied(now) > 2)
                red, blue = middle_of(page, RED), middle_of(page, BLUE)
                page.click(*red)
                summary(page, "blocks 1")
                page.press("Save as masks")
                page.wait_for_text("1 of 2 objects are picked, blocks 2 not")
                page.write("Name", "low")
                page.wait(lambda: page.chosen("Picked") == "low")
                page.press("Another object")
                page.wait(lambda: page.chosen("Picked") == "blocks 2")
                page.click(*blue)
                summary(page, "blocks 2")
                page.press("Save as masks")
                page.wait_for_text("blocks 2 has no name of its own yet")
                page.write("Name", "high")
                page.wait(lambda: page.chosen("Picked") == "high")
                page.press("Save as masks")
                page.wait_for_text("The viewer closes now", 300)
        except BaseException as error:
            failed.append(error)
            process.kill()

    monkeypatch.setattr(demo_training, "finish", train)
    monkeypatch.setattr(demo_picks, "subprocess", SimpleNamespace(run=view))
    try:
        demo.run_demo(data, output, "beags-tiny", 1.0, 0, False, pick=True, objects=2)
    finally:
        assert not failed, failed[0]
    printed = capsys.readouterr().out
    assert "Now pick 2 objects in the viewer" in printed and str(output / "run/extracted/low/low.ply") in printed
    names = json.loads((output / "pick/classes.json").read_text())
    assert sorted(names.values()) == ["background", "high", "low"]
    assert (output / "contact_sheet.png").stat().st_size > 10_000
    summary_of_demo = json.loads((output / "summary.json").read_text())
    assert summary_of_demo["seconds"]["base training"] == pytest.approx(3.0, abs=0.1)  # refinement adds next to nothing
    surfels, owner = solids(dict.fromkeys(range(3), (0.5,) * 3))
    for name, block in (("low", 1), ("high", 2)):
        means = read_ply(output / f"run/extracted/{name}/{name}.ply")[0].means
        assert len(means) > 0.7 * int((owner == block).sum())
        nearest = owner[torch.cdist(means.double(), surfels.means.double()).argmin(dim=1)]
        assert float((nearest == block).float().mean()) > 0.7
