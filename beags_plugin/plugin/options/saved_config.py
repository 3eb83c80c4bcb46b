"""The config of a run that lies on disk, for nerfstudio: to train on, or to look at in its viewer."""

from __future__ import annotations

from pathlib import Path

import yaml

from beags_plugin.plugin.options.config import BeagsTrainerConfig
from beags_plugin.runs.relocation import relocate
from beags_plugin.runs.run_config import RunConfigLoader, loaded


def load_run_config(path: Path) -> BeagsTrainerConfig:
    """Read a run's config for nerfstudio without executing code; raises ``UserError`` as ``runs.run_config.loaded``."""
    return loaded(path, lambda text: yaml.load(text, Loader=RunConfigLoader), BeagsTrainerConfig)  # noqa: S506  (it refuses)


def open_for_training(config_path: Path, data: Path | None = None) -> BeagsTrainerConfig:
    """Open a run's config as ``runs.relocation.open_run`` does, for nerfstudio."""
    config = load_run_config(config_path)
    relocate(config, config_path, data)
    return config
