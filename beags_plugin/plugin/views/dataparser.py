"""Data parser ``beags-data``: the images, poses and masks of a scene in any registered layout, for nerfstudio.

Nothing here may import a data manager: nerfstudio loads this module while it is importing its own.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import (
    DataParser,
    DataParserConfig,
    DataparserOutputs,
    transform_poses_to_original_space,
)
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from torch import Tensor

from beags_plugin.plugin.views.ns_programs import prepare_reading, prepare_training
from beags_plugin.system.errors import print_user_errors_plainly
from beags_plugin.views.cameras import SceneCameras
from beags_plugin.views.data_options import DataOptions
from beags_plugin.views.scene_data import SceneData


@dataclass
class BeagsDataParserConfig(DataOptions, DataParserConfig):
    """Options of ``beags-data``."""

    _target: type = field(default_factory=lambda: BeagsDataParser)


class PlacedOutputs(DataparserOutputs):
    """nerfstudio's outputs with ``dataparser_transform`` [3, 4] in double precision, which also inverts poses."""

    def transform_poses_to_original_space(
        self, poses: Tensor, camera_convention: Literal["opengl", "opencv"] = "opencv"
    ) -> Tensor:
        transform = self.dataparser_transform.to(poses.device)
        back = transform_poses_to_original_space(
            poses.double(), transform.double(), self.dataparser_scale, camera_convention=camera_convention
        )
        exact = float(back[..., 3].abs().max()) * 2.0**-24 * self.dataparser_scale < 1e-5 if len(back) else True
        return back.to(poses.dtype) if exact else back


class BeagsDataParser(SceneData, DataParser):
    """Parser behind ``beags-data``: ``SceneData`` with nerfstudio's outputs; metadata are those of ``SplitData``."""

    config: BeagsDataParserConfig

    def __init__(self, config: BeagsDataParserConfig) -> None:
        print_user_errors_plainly()  # Other methods may use this parser too.
        DataParser.__init__(self, config)
        SceneData.__init__(self, config)

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        views = self.split(split)
        return PlacedOutputs(
            image_filenames=views.images,
            cameras=nerfstudio_cameras(views.cameras),
            scene_box=SceneBox(aabb=torch.tensor([[-1.0] * 3, [1.0] * 3])),
            dataparser_transform=views.placing.original,
            dataparser_scale=views.placing.original_scale,
            metadata=views.metadata,
        )


def nerfstudio_cameras(cameras: SceneCameras) -> Cameras:
    """Return nerfstudio's cameras."""
    return Cameras(**{each.name: getattr(cameras, each.name) for each in fields(cameras)})


def __getattr__(name: str) -> DataParserSpecification:
    """Return ``beags_data``, the target of nerfstudio's entry point, after preparing the program that reads it."""
    if name != "beags_data":
        raise AttributeError(name)
    prepare_training()
    prepare_reading()
    return DataParserSpecification(
        config=BeagsDataParserConfig(),
        description="Scenes with class id images: nerfstudio, COLMAP, LLFF and other layouts (BEA-GS).",
    )
