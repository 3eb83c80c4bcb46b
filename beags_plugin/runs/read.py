"""Read parts of runs: the trained scene, and the options of its views."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from beags_plugin.core.exposure import Exposures
from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.runs.checkpoint_file import exposures_of, model_state, read_checkpoint
from beags_plugin.runs.layout import newest_checkpoint
from beags_plugin.runs.picked import with_picked
from beags_plugin.runs.relocation import open_run
from beags_plugin.runs.run_config import RunConfig
from beags_plugin.views.data_options import RunViewOptions


@dataclass(frozen=True)
class SavedScene:
    """A trained run on disk: config, model state (tensors by name), step and class names.

    picked: whether the classes were picked in the viewer instead of trained.
    """

    config: RunConfig
    state: dict[str, Any]
    step: int
    classes: dict[int, str]
    picked: bool = False

    def surfels(self) -> Surfels:
        """Return the scene's N Gaussians."""
        state = {name: self.state[f"gauss_params.{name}"] for name in ("means", "quats", "scales", "opacities")}
        dc, rest = self.state["gauss_params.features_dc"], self.state["gauss_params.features_rest"]
        return Surfels(state["means"], state["quats"], state["scales"], state["opacities"][:, 0], dc, rest)

    @property
    def assigned(self) -> bool:
        """Return whether the Gaussians have classes."""
        return bool(self.state["assigned"])

    @property
    def members(self) -> Membership:
        """Return which Gaussians belong to which class; before they have classes, all belong to the background."""
        return Membership(self.state["class_ids"], self.state["_extra_state"].get("objects"))

    @property
    def exposures(self) -> Exposures | None:
        """Return the exposures of the training photos; None if all have the same."""
        return exposures_of(self.state["_extra_state"])

    @property
    def settings(self) -> RasterSettings:
        """Return the depth range."""
        extent, model = float(self.state["extent"]), self.config.model_config
        return RasterSettings(model.near * extent, model.far * extent)


def read_scene(config: RunConfig, config_path: Path) -> SavedScene:
    """Read a run's newest checkpoint, with the classes picked in the viewer (``runs.picked``).

    Raises ``UserError`` if the run is incomplete or a file is damaged.
    """
    path = newest_checkpoint(config.get_checkpoint_dir())
    checkpoint = read_checkpoint(path)
    trained = model_state(checkpoint, path)
    state = with_picked(trained, config_path.parent)
    return SavedScene(config, state, checkpoint["step"], state["_extra_state"]["classes"], state is not trained)


def read_run(config_path: Path) -> SavedScene:
    """Open a run and read only its scene."""
    return read_scene(open_run(config_path), config_path)


def view_options(config: RunConfig) -> RunViewOptions:
    """Return the options of a run's views, with the folder in which its data lie now."""
    parser = replace(config.data_config.dataparser, data=config.data_path)
    return replace(config.data_config, dataparser=parser, data=parser.data)
