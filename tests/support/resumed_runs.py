"""Short runs in this process, interrupted at chosen moments, and what is left of them on disk."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from same_bits import differences, without_clocks

STEPS = 45, 12  # steps of base and refinement


class Killed(BaseException):
    """An end that no program catches, as of a kill."""


def short_config(data: Path, run: Path, **overrides):
    """Return a run of all phases in a second: growth, preparation, frequent checkpoints."""
    from beags_plugin.plugin.presets import preset_config

    values = {
        "pipeline.model.base_steps": STEPS[0],
        "pipeline.model.refine_steps": STEPS[1],
        "pipeline.model.densify.start": 5,
        "pipeline.model.densify.every": 10,
        "pipeline.model.densify.stop": 40,
        "pipeline.model.densify.reset_every": 15,
        "pipeline.datamanager.dataparser.num_random_points": 300,
        "optimizers.opacities.optimizer.lr": 0.5,  # opaque after so few steps
        "pipeline.model.losses.normal.start": 12,
        "pipeline.model.sh_degree_interval": 15,
        "pipeline.model.background_color": "random",
        "pipeline.model.prepare.k": 10,
        "steps_per_save": 7,
        "steps_per_eval_image": 11,  # the last base step too
        "vis": "tensorboard",
        **overrides,
    }
    config = preset_config("beags-tiny", values, Path("test"))
    config.data, config.run_dir = data, run
    config.logging.local_writer.enable = False
    return config


def run_to_end(config):
    """Train as ns-train does."""
    from beags_plugin.plugin.launch import train

    train(config)


def resume_to_end(run: Path, device: str | None = None):
    """Resume a run as ``beags resume`` does."""
    from beags_plugin.plugin.launch import resume

    resume(run, device)


def checkpoint_of(run: Path) -> dict:
    """Return the only checkpoint of a run."""
    (path,) = (run / "nerfstudio_models").iterdir()
    return torch.load(path, weights_only=True)


def assert_same_run(one: Path, other: Path, but_for: str = "nothing"):
    """Assert that two runs ended with the same checkpoint, bit for bit, and masks.

    but_for: where in the checkpoint differences are no matter.
    """
    found = differences(without_clocks(checkpoint_of(one)), without_clocks(checkpoint_of(other)))
    found = [where for where in found if not where.startswith(but_for)]
    assert not found, found[:9]
    folders = one / "prepared/masks", other / "prepared/masks"
    files, others = (sorted(path.relative_to(folder) for path in folder.rglob("*.png")) for folder in folders)
    assert files and files == others
    assert all((folders[0] / name).read_bytes() == (folders[1] / name).read_bytes() for name in files)


def kill_at(monkeypatch, step, after=False):
    """Let the training end as by a kill before or in the middle of a step."""
    from beags_plugin.plugin.trainer import BeagsTrainer

    train = BeagsTrainer.train_iteration

    def iteration(self, now):
        if now == step and not after:
            raise Killed
        found = train(self, now)
        if now == step:
            raise Killed
        return found

    monkeypatch.setattr(BeagsTrainer, "train_iteration", iteration)


def killed(*_, **__):
    raise Killed


def interrupted(data, run, monkeypatch, kill, **overrides):
    """Start a run and let ``kill`` end it."""
    with monkeypatch.context() as patch:
        kill(patch)
        with pytest.raises(Killed):
            run_to_end(short_config(data, run, **overrides))
