"""The roads of docs/: the commands of a section, read from the document and run one after the other.

Trainings are a few steps long, on nine small photos; the first road begins without masks.
"""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from called_programs import called
from places import ROOT
from run_folders import write_drawn_scene
from start_scenes import write_splatfacto
from test_documented_commands import commands_of, training_config, words_of

from beags_plugin.labels.classes import read_id_mask
from beags_plugin.plugin.launch import train
from beags_plugin.splat_io.ply import write_ply


def section(document: str, heading: str) -> str:
    """Return the text below a heading, up to the next."""
    found = re.search(rf"^#+ {heading}.*?\n(.*?)(?=^#|\Z)", (ROOT / "docs" / document).read_text("utf8"), re.M | re.S)
    assert found is not None, f"{document} has no {heading}"
    return found[1]


class Reader:
    """A user in a folder with a scene without masks, a point on each object in one photo, and a scene to start from."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.data = folder, folder / "my_scene"
        surfels = write_drawn_scene(self.data)
        objects = []
        for class_id, name in ((1, "cup"), (2, "box")):
            row, column = np.nonzero(read_id_mask(self.data / "masks/v01.png") == class_id)
            point = [int(np.median(column)), int(np.median(row))]
            objects.append({"name": name, "prompts": [{"view": "v01", "points": [point]}]})
        (self.data / "prompts.json").write_text(json.dumps({"objects": objects}))
        shutil.rmtree(self.data / "masks")
        (self.data / "classes.json").unlink()
        write_ply(folder / "scene.ply", surfels)
        write_splatfacto(folder / "outputs/my_scene/splatfacto/RUN", surfels, (torch.eye(4)[:3], 1.0))
        self.runs: list[Path] = []

    def does(self, line: str) -> Path | None:
        """Run a command as it stands, but shorter; return the run of a training."""
        if self.runs:
            line = line.replace("$PWD/outputs", "outputs")
            line = line.replace("outputs/.../nerfstudio_models", f"{self.runs[0]}/nerfstudio_models")
            line = re.sub(r"(outputs/)?\.\.\./", f"{self.runs[-1]}/", line)
        program, *words = words_of(line)
        if program == "beags":
            called(program, *words)
            return None
        config = training_config(words)
        config.vis, config.run_dir = "tensorboard", self.folder / f"run_{len(self.runs)}"
        model, parser = config.model_config, config.data_config.dataparser
        model.base_steps, model.refine_steps = min(model.base_steps, 20), min(model.refine_steps, 2)
        model.close_contacts = False  # that takes longer than all steps
        model.prepare, parser.num_random_points = type(model.prepare)(k=5), 300
        config.optimizers["opacities"]["optimizer"].lr = 0.5  # opaque after so few steps
        config.data_config.data = config.data or config.data_config.data  # ns-train does the same.
        train(config)
        self.runs.append(config.run_dir)
        return config.run_dir


@pytest.fixture(scope="module")
def reader(tmp_path_factory):
    return Reader(tmp_path_factory.mktemp("reader"))


@pytest.mark.parametrize(
    ("document", "heading", "programs"),
    [
        ("masks.md", "Cut", ["ns-train", "beags", "ns-train"]),
        ("masks.md", "Reproject", ["beags", "ns-train"]),
        ("training.md", "Starting from a trained scene", ["ns-train"] * 3),
    ],
)
def test_the_commands_of_a_road_lead_to_refined_objects(reader, monkeypatch, document, heading, programs):
    """The base of the first road knows no class; all others are refined with the classes of the masks made there."""
    monkeypatch.chdir(reader.folder)
    lines = commands_of(section(document, heading))
    assert [line.split()[0] for line in lines] == programs
    for line in lines:
        base_alone = "refine-steps 0" in line
        if (run := reader.does(line)) is not None:
            (checkpoint,) = (run / "nerfstudio_models").iterdir()
            state = torch.load(checkpoint, weights_only=True)["pipeline"]
            names = state["_model._extra_state"]["classes"]
            assert names == ({0: "background"} if base_alone else {0: "background", 1: "cup", 2: "box"}), line
            assert int(state["_model.refined_steps"]) == (0 if base_alone else 2), line
            assert bool(state["_model.assigned"]) != base_alone, line
