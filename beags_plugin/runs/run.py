"""A finished run as one object: opened once and passed down, each part read at its first use."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Literal

from torch import Tensor

from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.runs.read import SavedScene, read_scene, view_options
from beags_plugin.runs.relocation import check_data, open_run
from beags_plugin.runs.run_config import RunConfig
from beags_plugin.splat_io.frames import read_transform
from beags_plugin.surfaces.frames import Frame
from beags_plugin.surfaces.item import Viewpoints
from beags_plugin.system.errors import UserError
from beags_plugin.system.pasted import quoted
from beags_plugin.views.cameras import camera_from_nerfstudio
from beags_plugin.views.run_data import RunData
from beags_plugin.views.scene_data import SceneData


class Run:
    """A run on disk. Every part raises ``UserError`` if it is missing, damaged, or cannot be read.

    config_path: its config.yml. folder: the folder of that file.
    """

    def __init__(self, config_path: Path, data: Path | None = None) -> None:
        """Name a run; nothing is read yet. data: folder of its photos, if they were moved."""
        self.config_path = config_path
        self.folder = config_path.parent
        self._data = data
        self._splits: dict[str, RunData] = {}

    @cached_property
    def config(self) -> RunConfig:
        """The options of its training."""
        return open_run(self.config_path, self._data)

    @cached_property
    def scene(self) -> SavedScene:
        """The trained scene, with the classes picked in the viewer."""
        return read_scene(self.config, self.config_path)

    @property
    def assigned(self) -> SavedScene:
        """The scene with classes; raises ``UserError`` for a base without."""
        if not self.scene.assigned:
            raise UserError(
                f"{self.folder} is a base without classes: refine it first "
                f"(ns-train beags-refine --load-dir {quoted(self.config.get_checkpoint_dir())})."
            )
        return self.scene

    @cached_property
    def transform(self) -> tuple[Tensor, float] | None:
        """The data parser's transform ([3, 4] float64, scale); None if the run has no such file."""
        return read_transform(self.folder)

    @property
    def frame(self) -> Frame:
        """The frame of the input poses; the run's own if its normalisation is unknown."""
        return Frame.of_run() if self.transform is None else Frame(*self.transform)

    @cached_property
    def rasterizer(self) -> Rasterizer:
        """The backend that its config names."""
        return make_rasterizer(self.config.model_config.rasterizer)

    @property
    def settings(self) -> RasterSettings:
        """The depth range of its scene."""
        return self.scene.settings

    @cached_property
    def _data_alone(self) -> SceneData:
        return SceneData(view_options(self.config).dataparser, truth=False)

    def views(self, held_out: Literal["val", "test"]) -> RunData:
        """Return its data; held_out: the split of the views that were not trained on, "test" with exact masks."""
        if held_out not in self._splits:
            with self._reading_data():
                known = self._data_alone if held_out == "val" else None
                self._splits[held_out] = RunData(view_options(self.config), held_out, known)
        return self._splits[held_out]

    @cached_property
    def viewpoints(self) -> Viewpoints:
        """Its training views in its own frame; no photo is read, and lens distortion is not removed."""
        with self._reading_data():
            cameras = self._data_alone.split("train").cameras
        placed = [camera_from_nerfstudio(cameras, index) for index in range(len(cameras))]
        return Viewpoints(placed, self.rasterizer, self.settings)

    @contextmanager
    def _reading_data(self) -> Iterator[None]:
        """Raise ``UserError`` for missing data, and name the run in errors about them."""
        check_data(self.config.data_path, self.config_path)
        try:
            yield
        except UserError as error:
            raise UserError(f"the data of {self.config_path} cannot be read: {error}") from error
