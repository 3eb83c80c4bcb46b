"""Writing runs: checkpoints, and run folders on which every ns-* command works."""

from __future__ import annotations

import shutil
from copy import deepcopy
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import yaml
from torch import Tensor

from beags_plugin.plugin.options.run_format import CONFIG_FILE
from beags_plugin.plugin.runs.layout import TRANSFORM_FILE
from beags_plugin.plugin.runs.run_config import RunConfig, drop_gone, with_values
from beags_plugin.system.registry import load
from beags_plugin.system.whole_files import write_text_atomically, write_whole

if TYPE_CHECKING:
    from beags_plugin.plugin.options.config import BeagsTrainerConfig


def save_atomically(content: Any, path: Path) -> None:
    """Save by ``torch.save``; the path holds either the old file or the whole new one."""
    # beside the folder, not in it: nerfstudio takes any file among the checkpoints for one
    write_whole(path, lambda file: torch.save(content, file), path.parent.parent)


def write_run(config: BeagsTrainerConfig | RunConfig, folder: Path, model_state: dict[str, Tensor], step: int) -> Path:
    """Write a run that holds ``model_state`` of a ``BeagsModel``; returns the path of its config.yml.

    config: of the run it comes from. step: of the checkpoint.
    """
    folder = folder.absolute()
    state = {
        f"_model.{name}": value.detach().cpu() if isinstance(value, Tensor) else value
        for name, value in model_state.items()
    }
    checkpoint = {"step": step, "pipeline": state, "optimizers": {}, "schedulers": {}, "scalers": {}}
    path = folder / config.relative_model_dir / f"step-{step:09d}.ckpt"
    save_atomically(checkpoint, path)
    for old in path.parent.glob("*.ckpt"):  # of an earlier run into the same folder
        if old != path:
            old.unlink()
    config_path = folder / CONFIG_FILE
    write_text_atomically(_text(config, folder), config_path)
    transform = config.get_base_dir() / TRANSFORM_FILE
    if transform.exists() and transform.parent != folder:
        shutil.copyfile(transform, folder / TRANSFORM_FILE)
    return config_path


def _text(config: BeagsTrainerConfig | RunConfig, folder: Path) -> str:
    """Return the config.yml of a run in ``folder`` that was made of another."""
    first = dict.fromkeys(("load_dir", "load_checkpoint", "load_config", "load_step"))
    own = deepcopy(config)
    if not isinstance(own, RunConfig):
        for name, value in {**first, "run_dir": folder}.items():
            setattr(own, name, value)
        return load("beags_plugin.plugin.options.config:config_text")(own)
    assert own.source is not None
    views = own.data_config
    data = {"pipeline.datamanager.data": views.data, "pipeline.datamanager.dataparser.data": views.dataparser.data}
    drop_gone(own.source)
    with_values(own.source, {**first, "run_dir": folder, **data})
    return yaml.serialize(own.source, width=10_000)
