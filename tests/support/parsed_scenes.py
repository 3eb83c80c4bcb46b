"""Scenes as the data parser reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from data_folders import (
    SCENES,
)

from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig

AS_GIVEN = dict(orientation_method="none", center_method="none", auto_scale_poses=False)


def parse(root: Path, split: str = "train", **options):
    return BeagsDataParserConfig(data=root, **options).setup().get_dataparser_outputs(split)


def names(outputs) -> list[str]:
    return [path.stem for path in outputs.image_filenames]


def pixel(camera, point) -> np.ndarray:
    """Where the method's camera sees a world point."""
    moved = camera.viewmat.double().numpy()[:3] @ [*point, 1.0]
    x, y, w = camera.K.double().numpy() @ moved
    return np.array([x / w, y / w])


def skip_without(scene: str) -> Path:
    if not (SCENES / scene).is_dir():
        pytest.skip(f"the capture {scene} is not on this machine")
    return SCENES / scene
