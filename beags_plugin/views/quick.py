"""Downscaling of photos for a training that takes minutes."""

from __future__ import annotations

import math
from pathlib import Path

from beags_plugin.data.files import image_size
from beags_plugin.system.errors import UserError
from beags_plugin.views.data_options import DataOptions
from beags_plugin.views.scene_data import SceneData

QUICK_PIXELS = 50_000  # most pixels of a view


def quick_downscale(data: Path) -> float:
    """Return the smallest whole factor that scales the images of ``data`` to at most ``QUICK_PIXELS``.

    It is 1 for data that cannot be read. Raises ``UserError`` for an image that cannot be read.
    """
    try:
        _, views = SceneData(DataOptions(data=data)).posed_views()
    except UserError:  # the training names what is wrong
        return 1.0
    width, height = image_size(views.images[0])
    return max(1.0, float(math.ceil(math.sqrt(width * height / QUICK_PIXELS))))
