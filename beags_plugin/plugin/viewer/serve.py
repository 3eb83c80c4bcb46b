"""The viewer of a run, also of other people's: its files are read as data, and only this computer is served."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, cast

import torch
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.pipelines.base_pipeline import Pipeline
from nerfstudio.scripts.viewer.run_viewer import _start_viewer

from beags_plugin.core.membership import Membership
from beags_plugin.plugin.options.config import base_config
from beags_plugin.plugin.options.machine import default_device
from beags_plugin.plugin.options.saved_config import open_for_training
from beags_plugin.runs.checkpoint_file import model_state, read_checkpoint
from beags_plugin.runs.layout import newest_checkpoint
from beags_plugin.runs.relocation import check_data

if TYPE_CHECKING:
    from beags_plugin.plugin.options.config import BeagsTrainerConfig
    from beags_plugin.plugin.viewer.errand import Errand
    from beags_plugin.plugin.viewer.viewing import Viewing

HOST = "127.0.0.1"


def viewed_pipeline(config_path: Path, data: Path | None = None) -> tuple[BeagsTrainerConfig, Pipeline, int]:
    """Read a run as ns-viewer does, but without running code that its files name; return config, pipeline and step.

    data: folder of the photos, if they were moved. Raises ``UserError``.
    """
    config = open_for_training(config_path, data)
    check_data(config.data_path, config_path)
    ours = base_config()
    config.pipeline._target, config.model_config._target = ours.pipeline._target, ours.model_config._target
    config.data_config._target = ours.data_config._target
    path = newest_checkpoint(config.get_checkpoint_dir())
    checkpoint = read_checkpoint(path)
    model_state(checkpoint, path)
    pipeline = config.pipeline.setup(device=torch.device(default_device()), test_mode="test")
    pipeline.eval()
    pipeline.load_pipeline(checkpoint["pipeline"], checkpoint["step"])
    pipeline.datamanager.get_datapath = config.get_base_dir  # Camera paths are saved there.
    return config, pipeline, checkpoint["step"]


def serve(config_path: Path, data: Path | None = None, port: int | None = None, errand: Errand | None = None) -> None:
    """Show a run in the browser until Ctrl-C; see ``viewed_pipeline``.

    port: the first free one if None. errand: objects to pick, instead of the run's; once they are saved, the process
    ends.
    """
    config, pipeline, step = viewed_pipeline(config_path, data)
    if errand is not None:
        viewing = cast("Viewing", pipeline.model.viewing)
        viewing.errand = errand
        viewing.model.take_members(Membership(torch.zeros_like(viewing.model.class_ids)))
        viewing.model.assigned.fill_(False)
    config.vis = "viewer"
    config.viewer = ViewerConfig(websocket_host=HOST, websocket_port=port)
    try:
        _start_viewer(config, pipeline, step)
    except KeyboardInterrupt:
        sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]  # The panel's hook ends the process.
