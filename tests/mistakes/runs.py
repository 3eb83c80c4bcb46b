"""Runs, their configs and their checkpoints that cannot be used."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from data_folders import HEIGHT, noise, write_image

from mistakes.table import SHORT, Place, beags_after, mistake, mistakes

EXTRACT = "extract --load-config {run}"
EVAL = "eval --load-config {run}"


def config(change: Callable[[str], str], words: str = EXTRACT) -> Callable[[Place], Any]:
    """Return a mistake in config.yml of a run."""

    def edit(at: Place) -> None:
        path = at.run / "config.yml"
        path.write_text(change(path.read_text("utf8")), "utf8")

    return beags_after(edit, words)


def replaced(old: str, new: str, words: str = EXTRACT) -> Callable[[Place], Any]:
    return config(lambda text: text.replace(old, new), words)


def checkpoint(change: Callable[[Path], Any], words: str = EXTRACT) -> Callable[[Place], Any]:
    """Return a mistake in the checkpoint of a run."""
    return beags_after(lambda at: change(at.checkpoint), words)


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


ENDLESS = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))


def move_data(at: Place) -> None:
    at.run  # noqa: B018  (made before its data go)
    at.data.rename(at.root / "elsewhere")


def copied(without: str, words: str, change: Callable[[Place], Any] = lambda at: None) -> Callable[[Place], Any]:
    """Return a mistake with a copy of a run that lacks a folder; the whole run stays where it was."""

    def make(at: Place) -> Any:
        shutil.copytree(at.run, at.root / "copy", ignore=lambda folder, names: {without})
        change(at)
        return at.beags(words.replace("{run}", str(at.root / "copy")))

    return make


mistakes(
    "configs",
    {
        "a class that has been renamed": replaced("model_options.BeagsModelConfig", "model_options.SceneConfig"),
        "of an older version": replaced("run_format: 3\n", ""),
        "a part of another kind": config(
            lambda text: re.sub(r"prepare: !!python/object:\S+", "prepare: !!python/object:builtins.dict", text)
        ),
        "YAML broken": config(lambda text: "\t{\n" + text),
        "cut off": config(lambda text: text[: text.index("\npipeline:") + 1]),
        "a command to run, hidden in a field": config(
            lambda text: text + "hidden: !!python/object/apply:os.system ['touch ran']\n"
        ),
        "aliases that grow without end": config(lambda text: ENDLESS),
        "data that have been moved": beags_after(move_data, EVAL),
        "a copy without its checkpoint": copied("nerfstudio_models", EXTRACT),
        "a copy elsewhere without its data": copied("", EVAL, move_data),
    },
)


def without_means(found: dict[str, Any]) -> None:
    del found["pipeline"]["_model.gauss_params.means"]


def without_boxes(found: dict[str, Any]) -> None:
    found["pipeline"]["_model.class_ids"].masked_fill_(found["pipeline"]["_model.class_ids"] == 2, 0)


def exchange_a_bit(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:900] + b"\xff\xff\xff\xff" + path.read_bytes()[904:])


mistakes(
    "checkpoints",
    {
        "a tensor is missing": checkpoint(content(without_means)),
        "a command to run": checkpoint(lambda path: torch.save(Code("touch ran"), path)),
        "a bit exchanged": checkpoint(exchange_a_bit),
    },
)


def transform(text: str) -> Callable[[Place], Any]:
    return beags_after(lambda at: (at.run / "dataparser_transforms.json").write_text(text), EXTRACT)


mistakes(
    "runs",
    {
        "load-step does not exist": lambda at: at.train(
            preset="beags-refine", load_dir=at.checkpoint.parent, load_step=7
        ),
        "load-checkpoint is damaged": lambda at: at.train(preset="beags-refine", load_checkpoint=at.cut(at.checkpoint)),
        "an object without Gaussians": checkpoint(content(without_boxes), "export --load-config {run} --object box"),
        "the transform of a run is broken": transform('{"transform": "x"}'),
        "a transform that squeezes the world": transform(
            '{"transform": [[0,0,0,0],[0,0,0,0],[0,0,0,0]], "scale": 0.0}'
        ),
    },
)


@mistake("runs", "load-dir is of a refinement of other classes")
def _(at: Place):
    run = broken_off(at)
    (at.data / "classes.json").write_text(CLASSES)
    return at.train(load_dir=run / "nerfstudio_models")


@mistake("runs", "load-dir is empty")
def _(at: Place):
    (at.root / "empty").mkdir()
    return at.train(preset="beags-refine", load_dir=at.root / "empty")


@mistake("runs", "two in one folder")
def _(at: Place):
    import fcntl

    folder = at.root / "trained"
    folder.mkdir()
    at.held = open(folder / ".lock", "ab")  # noqa: SIM115  (as another training holds it)
    fcntl.flock(at.held, fcntl.LOCK_EX)
    return at.train()


@mistake("runs", "no memory is left before the first checkpoint")
def _(at: Place):
    from beags_plugin.plugin.trainer import BeagsTrainer

    def growing(trainer, step):
        raise MemoryError

    at.patch.setattr(BeagsTrainer, "train_iteration", growing)
    return at.train()


def broken_off(at: Place) -> Path:
    """Return a run of ``data`` that ended in the middle of refinement."""
    import yaml

    from beags_plugin.plugin.options.saved_config import load_run_config

    short = at.config("--pipeline.model.base-steps", "6", "--pipeline.model.refine-steps", "8", *SHORT[4:])
    run = at.root / "run"
    shutil.copytree(at.templates.broken_off(short), run)
    config = load_run_config(run / "config.yml")
    config.data = config.data_config.data = config.data_config.dataparser.data = at.data
    (run / "config.yml").write_text(yaml.dump(config), "utf8")
    return run


def resumed(change: Callable[[Place, Path], Any]) -> Callable[[Place], Any]:
    """Return a mistake with a run that is to be resumed."""

    def make(at: Place):
        run = broken_off(at)
        change(at, run)
        return at.beags("resume", run)

    return make


def resumed_with(change: Callable[[dict[str, Any]], Any]) -> Callable[[Place], Any]:
    """Return a mistake in the checkpoint of a run that is to be resumed."""
    return resumed(lambda at, run: content(change)(at.checkpoint))


def finish(at: Place, run: Path) -> None:
    text = (run / "config.yml").read_text("utf8")
    (run / "config.yml").write_text(text.replace("refine_steps: 8", "refine_steps: 3"), "utf8")
    (run / "training.json").write_text("{}")


CLASSES = '{"1": "cup", "2": "box", "3": "hat"}'
mistakes(
    "resuming",
    {
        "a checkpoint of a newer version": resumed_with(lambda found: found["beags"].update(version=99)),
        "a state of training that is no table": resumed_with(lambda found: {**found, "beags": 3}),
        "a state of training of wrong content": resumed_with(
            lambda found: found["beags"]["parts"].update(views={"a": 1})
        ),
        "an optimizer is missing": resumed_with(lambda found: {**found, "optimizers": {}}),
        "a photo has gone since": resumed(
            lambda at, run: at.edit_poses(lambda meta: meta.update(frames=meta["frames"][2:]))
        ),
        "classes.json has changed since": resumed(lambda at, run: (at.data / "classes.json").write_text(CLASSES)),
        "the data have gone": resumed(lambda at, run: shutil.rmtree(at.data)),
        "prepared/ has gone": resumed(lambda at, run: shutil.rmtree(run / "prepared")),
        "the voxel grid is damaged": resumed(lambda at, run: at.cut(run / "prepared/grid.pt")),
        "the voxel grid lacks a part": resumed(
            lambda at, run: torch.save({"classes": torch.zeros(1)}, run / "prepared/grid.pt")
        ),
        "a prepared mask is missing": resumed(lambda at, run: next((run / "prepared/masks").iterdir()).unlink()),
        "a prepared mask is of another size": resumed(
            lambda at, run: write_image(run / "prepared/masks/v01.png", noise(0, 4, 3)[..., 0])
        ),
        "a finished run": resumed(finish),
    },
)


def hold_nothing_out(at: Place) -> None:
    at.run  # noqa: B018  (made with held-out views)
    names = [f"images/v{index:02d}.png" for index in range(9)]
    at.edit_poses(lambda meta: meta.update(train_filenames=names, test_filenames=[], val_filenames=[]))


HELD_OUT = "held_out: !!python/tuple "
mistakes(
    "evaluation",
    {
        "a held-out view that does not exist": replaced(f"{HELD_OUT}[]", f"{HELD_OUT}[nobody]", EVAL),
        "no held-out views": beags_after(hold_nothing_out, EVAL),
        "a silhouette of other proportions": beags_after(
            lambda at: write_image(
                at.data / "ground_truth/silhouettes/cup/v00.png", np.zeros((HEIGHT, HEIGHT), np.uint8)
            ),
            EVAL,
        ),
        "a silhouette that is a photo": beags_after(
            lambda at: write_image(at.data / "ground_truth/silhouettes/cup/v00.png", noise(0)), EVAL
        ),
        "a picture of an unknown kind": lambda at: at.beags(f"{EVAL} --picture worst.txt"),
    },
)
