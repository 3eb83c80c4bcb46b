"""Scenes on disk as the data parser reads them, and points as its cameras see them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from data_folders import SCENES

from beags_plugin.data.layout import find_layout
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.views.cameras import camera_from_nerfstudio

AS_GIVEN = dict(orientation_method="none", center_method="none", auto_scale_poses=False)
POINT = np.array([0.3, -0.2, 0.4])


def parse(root: Path, split: str = "train", **options):
    return BeagsDataParserConfig(data=root, **options).setup().get_dataparser_outputs(split)


def names(outputs) -> list[str]:
    return [path.stem for path in outputs.image_filenames]


def pixel(outputs, index: int, point) -> np.ndarray:
    """Return the pixel where the method's camera of a view sees a point of the outputs' world."""
    camera = camera_from_nerfstudio(outputs.cameras, index)
    x, y, w = camera.K.double().numpy() @ (camera.viewmat.double().numpy()[:3] @ [*point, 1.0])
    return np.array([x / w, y / w])


def moved(outputs, point) -> np.ndarray:
    """Return a point of the file's world in the outputs'."""
    transform = outputs.dataparser_transform.double().numpy()
    return outputs.dataparser_scale * (transform[:, :3] @ point + transform[:, 3])


def title(root: Path, layout: str = "auto") -> str:
    return find_layout(root, layout).title


def real(scene: str) -> Path:
    if not (SCENES / scene).is_dir():
        pytest.skip(f"the capture {scene} is not on this machine")
    return SCENES / scene
