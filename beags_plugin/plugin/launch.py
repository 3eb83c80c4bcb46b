"""Training from Python, as ``ns-train`` does it, and resuming an interrupted run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from beags_plugin.options.run_format import CONFIG_FILE
from beags_plugin.plugin.views.ns_programs import leave_out_other_methods
from beags_plugin.runs.layout import EXTRACTION_FILE, REPORT_FILE
from beags_plugin.system.errors import UserError
from beags_plugin.system.pasted import quoted
from beags_plugin.system.progress import say

if TYPE_CHECKING:
    from beags_plugin.plugin.options.config import BeagsTrainerConfig


def train(config: BeagsTrainerConfig) -> None:
    """Run the training of ``config`` into its ``run_dir``; raises ``UserError`` where ``ns-train`` would end."""
    leave_out_other_methods()
    from nerfstudio.scripts.train import main

    _complete(lambda: main(config), config)


def resume(
    run: Path, device: Literal["cpu", "cuda"] | None = None, check_memory: bool = True, data: Path | None = None
) -> None:
    """Train an interrupted run to its end, in its own folder and with its own config.

    run: its folder, or config.yml in it. device: replaces the config's. check_memory: as in ``BeagsTrainerConfig``.
    data: folder of the photos, if they were moved. Without a checkpoint the training starts from the beginning. Raises
    ``UserError`` for another folder and for a complete run.
    """
    leave_out_other_methods()
    from nerfstudio.scripts.train import launch, train_loop

    from beags_plugin.plugin.options.machine import check_machine

    config = resumed_config(run, data)
    machine = config.machine
    config.check_memory = config.check_memory and check_memory
    if device is not None:
        machine.device_type = device
    check_machine(machine)
    _complete(lambda: launch(train_loop, num_devices_per_machine=1, config=config), config)


def resumed_config(run: Path, data: Path | None = None) -> BeagsTrainerConfig:
    """Return the config with which ``resume`` trains."""
    from beags_plugin.plugin.options.saved_config import open_for_training
    from beags_plugin.runs.checkpoint_file import read_checkpoint, scene_alone
    from beags_plugin.runs.layout import newest_checkpoint
    from beags_plugin.runs.relocation import check_data

    path = Path(run)
    path = path / CONFIG_FILE if path.is_dir() else path
    config = open_for_training(path, data)
    check_data(config.data_path, path)
    folder, models = config.get_base_dir(), config.get_checkpoint_dir()
    if not any(models.glob("step-*.ckpt")):
        say(f"{folder} holds no checkpoint yet, so training starts from the beginning.")
        return config
    if (folder / EXTRACTION_FILE).exists() or scene_alone(read_checkpoint(newest_checkpoint(models))):
        raise UserError(
            f"{folder} holds a scene without the state of its training: resume the run that it comes from, or refine "
            f"it: ns-train beags-refine --load-dir {quoted(models)}."
        )
    config.load_dir, config.load_checkpoint, config.load_step = models, None, None
    return config


def _complete(run: Callable[[], None], config: BeagsTrainerConfig) -> None:
    """Run a training; raise the error that ended it early."""
    try:
        run()
    except SystemExit as end:
        if isinstance(end.__cause__, (UserError, KeyboardInterrupt)):
            raise end.__cause__ from None
        raise
    if not (config.get_base_dir() / REPORT_FILE).exists():
        raise KeyboardInterrupt  # Nerfstudio catches an interrupt, prints it and returns.
