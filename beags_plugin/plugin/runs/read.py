"""Reading runs: the trained scene, the frame it was trained in, and the data it was trained on."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

import torch
from torch import Tensor

from beags_plugin.core.exposure import Exposures
from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.export.base import Viewpoints
from beags_plugin.plugin.options.config import BeagsTrainerConfig
from beags_plugin.plugin.runs.checkpoint_file import exposures_of, model_state, read_checkpoint
from beags_plugin.plugin.runs.layout import TRANSFORM_FILE, newest_checkpoint
from beags_plugin.plugin.runs.picked import with_picked
from beags_plugin.plugin.runs.place import check_data, open_run
from beags_plugin.plugin.views.cameras import camera_from_nerfstudio
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.system.errors import UserError
from beags_plugin.system.pasted import quoted
from beags_plugin.system.reading.text import load_json, reason


@dataclass(frozen=True)
class SavedScene:
    """A trained run on disk: config, model state (tensors by name), step and class names.

    picked: whether the classes are those picked in the viewer, not those that the run trained.
    """

    config: BeagsTrainerConfig
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
        """True if the Gaussians have classes."""
        return bool(self.state["assigned"])

    @property
    def members(self) -> Membership:
        """Which Gaussians belong to which class; all to the background before they have classes."""
        return Membership(self.state["class_ids"], self.state["_extra_state"].get("objects"))

    @property
    def exposures(self) -> Exposures | None:
        """Exposures of the training photos; None where they have one."""
        return exposures_of(self.state["_extra_state"])


def read_run(config_path: Path, data: Path | None = None) -> SavedScene:
    """Read a run's newest checkpoint, with what was picked in the viewer (``runs.picked``).

    Raises ``UserError`` if the run is incomplete or a file is damaged.

    data: its data, if not where they were.
    """
    config = open_run(config_path, data)
    path = newest_checkpoint(config.get_checkpoint_dir())
    checkpoint = read_checkpoint(path)
    trained = model_state(checkpoint, path)
    state = with_picked(trained, config_path.parent)
    return SavedScene(config, state, checkpoint["step"], state["_extra_state"]["classes"], state is not trained)


def read_assigned_run(config_path: Path, data: Path | None = None) -> SavedScene:
    """Do as ``read_run``; raises ``UserError`` too if no class was assigned."""
    scene = read_run(config_path, data)
    if not scene.assigned:
        raise UserError(
            f"{config_path.parent} is a base without classes: refine it first "
            f"(ns-train beags-refine --load-dir {quoted(scene.config.get_checkpoint_dir())})."
        )
    return scene


def raster_settings(scene: SavedScene) -> RasterSettings:
    """Return the depth range of a saved scene."""
    extent, model = float(scene.state["extent"]), scene.config.model_config
    return RasterSettings(model.near * extent, model.far * extent)


def read_transform(run: Path) -> tuple[Tensor, float] | None:
    """Read the data parser's transform ([3, 4], scale) of a run; None if the run has no file of it.

    Raises ``UserError`` if the file is damaged.
    """
    path = run / TRANSFORM_FILE
    if not path.exists():
        return None
    try:
        content = load_json(path)
        transform, scale = torch.tensor(content["transform"], dtype=torch.float64), float(content["scale"])
        if transform.shape != (3, 4):
            raise ValueError(f"its transform is {list(transform.shape)}, not [3, 4]")
        if not (bool(transform.isfinite().all()) and 0 < scale < math.inf):
            raise ValueError("it holds what is no number, or a scale that is not above 0")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} cannot be read ({reason(error)}): restore it.") from error
    return transform, scale


@contextmanager
def _data(config: BeagsTrainerConfig, config_path: Path) -> Iterator[None]:
    """Name the run in errors about its data, and refuse data that are gone."""
    check_data(config.data_path, config_path)
    try:
        yield
    except UserError as error:
        raise UserError(f"the data of {config_path} cannot be read: {error}") from error


def data_of_run(config: BeagsTrainerConfig, config_path: Path, split: Literal["val", "test"]) -> BeagsDataManager:
    """Open the data that a run was trained on.

    split: which held-out views to prepare. config_path: of the run, for messages. Raises ``UserError`` for data that
    are gone or cannot be read.
    """
    with _data(config, config_path):
        made = config.data_config.setup(device="cpu", test_mode=split, world_size=1, local_rank=0)
        return cast(BeagsDataManager, made)


def training_viewpoints(config: BeagsTrainerConfig, settings: RasterSettings, config_path: Path) -> Viewpoints:
    """Return the training views of a run, in its own frame; raises ``UserError`` if its data cannot be read.

    settings: depth range of the scene. config_path: of the run, for messages.
    """
    with _data(config, config_path):
        # Poses alone: no photo is read, and lens distortion does not matter to where one looks from.
        parser = replace(config.data_config.dataparser, data=config.data_path).setup()
        cameras = parser.get_dataparser_outputs(split="train").cameras
    return Viewpoints(
        [camera_from_nerfstudio(cameras, index) for index in range(len(cameras))],
        make_rasterizer(config.model_config.rasterizer),
        settings,
    )
