"""Write runs: checkpoints, and run folders on which every ns-* command works."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from beags_plugin.options.run_format import CONFIG_FILE
from beags_plugin.runs.checkpoint_file import SAW_CLOSE_UPS
from beags_plugin.runs.relocation import AnyConfig
from beags_plugin.splat_io.frames import TRANSFORM_FILE
from beags_plugin.system.whole_files import write_text_atomically, write_whole


def save_atomically(content: Any, path: Path) -> None:
    """Save by ``torch.save``; the path holds either the old file or the whole new one."""
    # The unfinished file lies beside the folder, because nerfstudio takes any file in it for a checkpoint.
    write_whole(path, lambda file: torch.save(content, file), path.parent.parent)


def write_run(
    config: AnyConfig, folder: Path, model_state: dict[str, Tensor], step: int, close_ups: bool = False
) -> Path:
    """Write a run that holds ``model_state`` of a ``BeagsModel``; returns the path of its config.yml.

    config: of the run from which it is made. step: of the checkpoint. close_ups: whether its training saw close-ups.
    """
    folder = folder.absolute()
    state = {
        f"_model.{name}": value.detach().cpu() if isinstance(value, Tensor) else value
        for name, value in model_state.items()
    }
    checkpoint = {"step": step, "pipeline": state, "optimizers": {}, "schedulers": {}, "scalers": {}}
    if close_ups:
        checkpoint[SAW_CLOSE_UPS] = True
    path = folder / config.relative_model_dir / f"step-{step:09d}.ckpt"
    save_atomically(checkpoint, path)
    for old in path.parent.glob("*.ckpt"):  # An earlier run may have been written here.
        if old != path:
            old.unlink()
    config_path = folder / CONFIG_FILE
    write_text_atomically(config.text_in(folder), config_path)
    transform = config.get_base_dir() / TRANSFORM_FILE
    if transform.exists() and transform.parent != folder:
        shutil.copyfile(transform, folder / TRANSFORM_FILE)
    return config_path
