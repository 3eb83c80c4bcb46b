"""The masks of a run's training views, as they came and as reprojection left them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from beags_plugin.labels.class_ids import resize_nearest
from beags_plugin.labels.classes import read_class_map, read_mask
from beags_plugin.plugin.runs.layout import last_prepared
from beags_plugin.plugin.views.views import unique_names

if TYPE_CHECKING:
    import numpy.typing as npt

    from beags_plugin.plugin.options.config import BeagsTrainerConfig


@dataclass(frozen=True)
class TrainingMasks:
    """The masks of one training view, all [h, w] uint16 class ids or IGNORE, of the size that was trained on.

    photo: the image file. given: what the data has; used: what refinement was given after reprojection; exact: the
    truth. None where there is none. confidence: file of the share of the winning votes, may not exist.
    """

    name: str
    photo: Path
    given: npt.NDArray[np.uint16] | None
    used: npt.NDArray[np.uint16]
    exact: npt.NDArray[np.uint16] | None
    confidence: Path


def training_masks(config: BeagsTrainerConfig) -> list[TrainingMasks]:
    """The masks of every training view of a run that refined, before and after reprojection.

    Masks and truth are compared as the files have them: for photos without lens distortion.
    """
    parser = replace(config.data_config.dataparser, data=config.data_path)
    outputs = parser.setup().get_dataparser_outputs("train")
    metadata = outputs.metadata
    exact = (metadata["ground_truth"] or {}).get("masks") or [None] * len(outputs.image_filenames)
    prepared = last_prepared(config.get_base_dir())
    views = []
    for index, (name, photo) in enumerate(
        zip(unique_names(outputs.image_filenames), outputs.image_filenames, strict=True)
    ):
        used = read_class_map(prepared / "masks" / f"{name}.png")

        def sized(path: Path | None, kind: str, like: np.ndarray = used) -> np.ndarray | None:
            if path is None:
                return None
            return resize_nearest(read_mask(path, kind, metadata["ignore_ids"]), *like.shape)

        given = sized(metadata["class_map_filenames"][index], metadata["mask_kind"])
        confidence = prepared / "confidence" / f"{name}.png"
        views.append(TrainingMasks(name, photo, given, used, sized(exact[index], "ids"), confidence))
    return views
