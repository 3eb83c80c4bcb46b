"""A training in several processes, each with a replica of the scene: see notes/speed.md, "Several GPUs".

Each step, every process renders a view of its own, and the gradients are averaged; all else that changes the scene is
computed alike in all. Only the first process writes the run: the others write into a folder that they remove.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from rich import get_console
from torch import nn

from beags_plugin.ops import cuda_extension
from beags_plugin.plugin.options.config import BeagsTrainerConfig
from beags_plugin.system import processes


class Replica:
    """One process of a training.

    config: the run's; in processes other than the first it is changed to write elsewhere, and to show and measure
    nothing. local_rank: number of this process, and of its GPU, on its machine. run: the folder of the run.
    """

    def __init__(self, config: BeagsTrainerConfig, local_rank: int) -> None:
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.run = config.get_base_dir()
        if config.machine.device_type == "cuda" and cuda_extension.status()[1] is None:
            torch.cuda.set_device(local_rank)  # else all processes would exchange objects through the first GPU
        if processes.rank() > 0:
            self._folder = tempfile.TemporaryDirectory(prefix="beags-rank-", ignore_cleanup_errors=True)
            config.run_dir = Path(self._folder.name)
            config.steps_per_eval_image = config.steps_per_eval_batch = config.steps_per_eval_all_images = 0
            config.steps_per_held_out = config.steps_per_objects = 0
            config.viewer.quit_on_train_completion = True
            CONSOLE.quiet = get_console().quiet = True

    def start_alike(self, scene: nn.Module) -> None:
        """Copy the scene of the first process to all."""
        processes.take_from_first(value.detach() for value in (*scene.parameters(), *scene.buffers()))

    def end(self) -> None:
        """Remove the folder of a process other than the first."""
        if self._folder is not None:
            self._folder.cleanup()
