"""Runs, their configs and their checkpoints that cannot be used."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from data_folders import noise, write_image

from mistakes.table import SHORT, Place, mistake

NAMES = "_model.gauss_params.means"


def config(change: Callable[[str], str | bytes]) -> Callable[[Place], Any]:
    """A mistake in config.yml of a run."""

    def make(at: Place):
        path = at.run / "config.yml"
        changed = change(path.read_text("utf8"))
        path.write_bytes(changed if isinstance(changed, bytes) else changed.encode())
        return at.beags("extract --load-config {run}")

    return make


def checkpoint(change: Callable[[Path], Any], words: str = "extract --load-config {run}") -> Callable[[Place], Any]:
    """A mistake in the checkpoint of a run."""

    def make(at: Place):
        change(at.checkpoint)
        return at.beags(words)

    return make


def content(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def edit(path: Path) -> None:
        found = torch.load(path, weights_only=True)
        torch.save(change(found) or found, path)

    return edit


class Code:
    """Runs a command wherever it is unpickled."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self):
        import os

        return os.system, (self.command,)


mistake("configs", "a class that has been renamed")(
    config(lambda text: text.replace("plugin.model.BeagsModelConfig", "plugin.model.BeagsSceneConfig"))
)
mistake("configs", "a module that has been renamed")(
    config(lambda text: text.replace("plugin.model.", "plugin.scene."))
)
mistake("configs", "of an older version")(config(lambda text: text.replace("run_format: 2\n", "")))
mistake("configs", "a part of another kind")(
    config(lambda text: re.sub(r"prepare: !!python/object:\S+", "prepare: !!python/object:builtins.dict", text))
)
mistake("configs", "YAML broken")(config(lambda text: "\t{\n" + text))
mistake("configs", "cut off")(config(lambda text: text[: text.index("\npipeline:") + 1]))
mistake("configs", "a command to run, hidden in a field")(
    config(lambda text: text + "hidden: !!python/object/apply:os.system ['touch ran']\n")
)
mistake("configs", "aliases that grow without end")(
    config(
        lambda text: (
            "a0: &a0 [x, x]\n"
            + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))
        )
    )
)


@mistake("configs", "data that have been moved")
def _(at: Place):
    at.run  # noqa: B018  (made before its data go)
    at.data.rename(at.root / "elsewhere")
    return at.beags("eval --load-config {run}")


mistake("checkpoints", "a tensor is missing")(checkpoint(content(lambda found: {**found, "pipeline": {
    name: value for name, value in found["pipeline"].items() if name != NAMES}})))  # fmt: skip
mistake("checkpoints", "a command to run")(checkpoint(lambda path: torch.save(Code("touch ran"), path)))
mistake("checkpoints", "a bit exchanged")(
    checkpoint(lambda path: path.write_bytes(path.read_bytes()[:900] + b"\xff\xff\xff\xff" + path.read_bytes()[904:]))
)


@mistake("runs", "load-dir is empty")
def _(at: Place):
    (at.root / "empty").mkdir()
    return at.train(preset="beags-refine", load_dir=at.root / "empty")


@mistake("runs", "load-step does not exist")
def _(at: Place):
    return at.train(preset="beags-refine", load_dir=at.checkpoint.parent, load_step=7)


@mistake("runs", "load-checkpoint is damaged")
def _(at: Place):
    at.cut(at.checkpoint)
    return at.train(preset="beags-refine", load_checkpoint=at.checkpoint)


@mistake("runs", "two in one folder")
def _(at: Place):
    import fcntl

    folder = at.root / "trained"
    folder.mkdir()
    at.held = open(folder / ".lock", "ab")  # noqa: SIM115  (as another training holds it)
    fcntl.flock(at.held, fcntl.LOCK_EX)
    return at.train()


@mistake("runs", "an object without Gaussians")
def _(at: Place):
    def change(found):
        ids = found["pipeline"]["_model.class_ids"]
        found["pipeline"]["_model.class_ids"] = torch.where(ids == 2, 0, ids).to(ids.dtype)

    content(change)(at.checkpoint)
    return at.beags("export --load-config {run} --object box")


@mistake("runs", "the transform of a run is broken")
def _(at: Place):
    (at.run / "dataparser_transforms.json").write_text('{"transform": "x"}')
    return at.beags("extract --load-config {run}")


@mistake("runs", "a transform that squeezes the world")
def _(at: Place):
    (at.run / "dataparser_transforms.json").write_text('{"transform": [[0,0,0,0],[0,0,0,0],[0,0,0,0]], "scale": 0.0}')
    return at.beags("extract --load-config {run}")


def broken_off(at: Place) -> Path:
    """A run of ``data`` that ended in the middle of refinement."""
    import yaml

    from beags_plugin.plugin.runs.run_config import load_run_config

    short = at.config("--pipeline.model.base-steps", "6", "--pipeline.model.refine-steps", "8", *SHORT[4:])
    run = at.root / "run"
    shutil.copytree(at.templates.broken_off(short), run)
    config = load_run_config(run / "config.yml")
    config.data = config.data_config.data = config.data_config.dataparser.data = at.data
    (run / "config.yml").write_text(yaml.dump(config), "utf8")
    return run


def resumed(change: Callable[[Place, Path], Any]) -> Callable[[Place], Any]:
    """A mistake with a run that is to be resumed."""

    def make(at: Place):
        run = broken_off(at)
        change(at, run)
        return at.beags("resume", run)

    return make


mistake("resuming", "a checkpoint of a newer version")(
    resumed(lambda at, run: content(lambda found: found["beags"].update(version=99))(at.checkpoint))
)
mistake("resuming", "a state of training that is no table")(
    resumed(lambda at, run: content(lambda found: {**found, "beags": 3})(at.checkpoint))
)
mistake("resuming", "a state of training of wrong content")(
    resumed(lambda at, run: content(lambda found: found["beags"]["parts"].update(views={"a": 1}))(at.checkpoint))
)
mistake("resuming", "an optimizer is missing")(
    resumed(lambda at, run: content(lambda found: found["optimizers"].pop("scene"))(at.checkpoint))
)
mistake("resuming", "a photo has gone since")(
    resumed(lambda at, run: at.edit_poses(lambda meta: meta.update(frames=meta["frames"][2:])))
)
mistake("resuming", "classes.json has changed since")(
    resumed(lambda at, run: (at.data / "classes.json").write_text('{"1": "cup", "2": "box", "3": "hat"}'))
)
mistake("resuming", "the data have gone")(resumed(lambda at, run: shutil.rmtree(at.data)))
mistake("resuming", "prepared/ has gone")(resumed(lambda at, run: shutil.rmtree(run / "prepared")))
mistake("resuming", "the voxel grid is damaged")(resumed(lambda at, run: at.cut(run / "prepared/grid.pt")))
mistake("resuming", "the voxel grid lacks a part")(
    resumed(lambda at, run: torch.save({"classes": torch.zeros(1)}, run / "prepared/grid.pt"))
)
mistake("resuming", "a prepared mask is missing")(
    resumed(lambda at, run: next((run / "prepared/masks").iterdir()).unlink())
)
mistake("resuming", "a prepared mask is of another size")(
    resumed(lambda at, run: write_image(run / "prepared/masks/v01.png", noise(0, 4, 3)[..., 0]))
)


@mistake("resuming", "a finished run")
def _(at: Place):
    run = broken_off(at)
    text = (run / "config.yml").read_text("utf8")
    (run / "config.yml").write_text(text.replace("refine_steps: 8", "refine_steps: 3"), "utf8")
    (run / "training.json").write_text("{}")
    return at.beags("resume", run)


@mistake("evaluation", "a held-out view that does not exist")
def _(at: Place):
    path = at.run / "config.yml"
    text = path.read_text("utf8")
    path.write_text(text.replace("held_out: !!python/tuple []", "held_out: !!python/tuple [nobody]"), "utf8")
    return at.beags("eval --load-config {run}")


@mistake("evaluation", "no held-out views")
def _(at: Place):
    at.run  # noqa: B018
    names = [f"images/v{index:02d}.png" for index in range(9)]
    at.edit_poses(lambda meta: meta.update(train_filenames=names, test_filenames=[], val_filenames=[]))
    return at.beags("eval --load-config {run}")


@mistake("evaluation", "a picture of an unknown kind")
def _(at: Place):
    return at.beags("eval --load-config {run} --picture worst.txt")
