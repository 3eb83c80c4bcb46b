"""``beags masks reproject``: masks reprojected with the depth of a trained run."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.classes import write_mask
from beags_plugin.labels.label_maps import CompressedMaps, LabelMaps
from beags_plugin.pictures.masks import Changed, before_and_after
from beags_plugin.preparation.consistent_masks import chosen_reprojection, render_depths, reprojected_masks
from beags_plugin.preparation.pipeline import check_options, known_classes
from beags_plugin.runs.relocation import check_data
from beags_plugin.runs.run import Run
from beags_plugin.system.errors import UserError, writing
from beags_plugin.system.filed_tensors import filed
from beags_plugin.system.progress import counted, progress_bar
from beags_plugin.system.wording import amount
from beags_plugin.views.run_data import RunData

if TYPE_CHECKING:
    from beags_plugin.runs.read import SavedScene
    from beags_plugin.views.data_options import DataOptions


@dataclass(frozen=True)
class ReprojectionOptions:
    """Differences from the run's own preparation of masks; None keeps the run's choice.

    masks: folder of other id images. classes: their classes.json. method: name of a reprojection. run_size: reproject
    at the size of the training instead of the photos'. parser: options of ``beags-data`` instead of the run's own.
    """

    masks: Path | None = None
    classes: Path | None = None
    method: str | None = None
    run_size: bool = False
    parser: DataOptions | None = None


@dataclass(frozen=True)
class ReprojectedRun:
    """The masks of V training views before and after, without lens distortion.

    given, voted: class ids; given is None for a view without a mask. confidence: [H, W] uint8, share of the votes times
    255. seconds: wall time. method: of reprojection. why: the reason for its choice, or None if the user chose it.
    """

    scene: SavedScene
    manager: RunData
    names: list[str]
    classes: dict[int, str]
    given: LabelMaps
    voted: LabelMaps
    confidence: CompressedMaps
    seconds: float
    method: str
    why: str | None

    def changed(self, view: int) -> Changed:
        """Return a view's masks before and after, for a picture."""
        given = self.given[view]
        photo = self.manager.views("train")[view].image
        return Changed(
            self.names[view],
            (255.0 * photo + 0.5).to(torch.uint8).numpy(),
            None if given is None else given.numpy(),
            self.voted[view].numpy(),
            self.confidence[view].numpy(),
        )


def reproject_run(run: Run, options: ReprojectionOptions) -> ReprojectedRun:
    """Reproject masks with the depth of a run, trained with or without masks.

    Raises ``UserError`` for a run, data or an option that cannot be used, and if no view has a mask.
    """
    scene, manager = run.scene, data_to_reproject(run, options)
    config = scene.config.model_config.prepare
    config = replace(config, reprojection=options.method or config.reprojection)
    if config.reprojection == "none":
        config = replace(config, reprojection="voxel")
    check_options(config)
    start = time.perf_counter()
    views = manager.views("train")
    with progress_bar("Reading masks", passing=True) as progress:
        given = LabelMaps(view.labels for view in counted(views, len(views), progress))
    if all(mask is None for mask in given.stored):
        raise UserError(f"no training view of {scene.config.data_path} has a mask: give --masks-path, or make some.")
    classes = manager.train_dataset.metadata["classes"]
    cameras = [view.camera for view in views]
    method, why = chosen_reprojection(config.reprojection, cameras, given)
    config = replace(config, reprojection=method)
    with progress_bar("Rendering depth") as progress:
        surfels = scene.surfels().detach()
        rendered = render_depths(surfels, cameras, run.rasterizer, run.settings, config.depth, progress)
        depths = filed(rendered, surfels.means.device)
    with progress_bar("Reprojecting masks") as progress:
        known = known_classes(given, classes)
        masks = reprojected_masks(depths, cameras, given, known, config, progress)
    assert masks.confidence is not None
    names = [view.name for view in views]
    seconds = time.perf_counter() - start
    return ReprojectedRun(scene, manager, names, classes, given, masks.labels, masks.confidence, seconds, method, why)


def data_to_reproject(run: Run, options: ReprojectionOptions) -> RunData:
    """Return the training data of a run, at the size and with the masks of ``options``."""
    config = run.config
    if options.parser is not None:
        parser = replace(options.parser)
    else:
        parser = replace(config.data_config.dataparser, data=config.data_path)
    check_data(parser.data, run.config_path)
    if options.masks is not None:
        if not options.masks.is_dir():
            raise UserError(f"the folder of masks {options.masks} does not exist: correct --masks-path.")
        parser.masks_path = options.masks.absolute()
        beside = options.masks.absolute().parent / "classes.json"
        classes = options.classes or (beside if beside.is_file() else None)
        parser.classes_path = parser.classes_path if classes is None else classes.absolute()
    data = replace(config.data_config, dataparser=parser, data=parser.data)
    if not options.run_size:
        parser.downscale_factor, data.camera_res_scale_factor = 1.0, 1.0
    return RunData(data, "val")


def write_reprojection(run: ReprojectedRun, output: Path) -> list[str]:
    """Write masks, confidence maps, a report and a picture of the views that changed most; return a summary.

    All maps have the size that ``reproject_run`` was given, and the photos' lens distortion, so that
    ``beags-data --masks-path`` can read them.
    """
    from PIL import Image

    with writing(output):
        changes = []
        for index, path in enumerate(mask_paths(run.manager.train_dataset.image_filenames)):
            voted = run.voted[index].numpy().astype(np.uint16)
            confidence = run.confidence[index].numpy()
            for folder in ("masks", "confidence"):
                (output / folder / path).parent.mkdir(parents=True, exist_ok=True)
            files = run.manager.files["train"]
            write_mask(output / "masks" / path, files.as_in_file(voted, index))
            Image.fromarray(files.as_in_file(confidence, index, border=0)).save(output / "confidence" / path)
            changes.append(_change(run, index))
        (output / "classes.json").write_text(json.dumps({str(i): name for i, name in run.classes.items()}, indent=1))
        report = {"method": run.method, "seconds": run.seconds, "views": changes}
        (output / "report.json").write_text(json.dumps(report, indent=1))
        order = sorted(range(len(changes)), key=lambda index: -changes[index]["changed"])[:6]
        before_and_after(output / "before_after.png", [run.changed(index) for index in order])
    pixels, changed = (sum(view[key] for view in changes) for key in ("labelled", "changed"))
    filled = sum(mask is None for mask in run.given.stored)
    return [
        *([run.why] if run.why else []),
        f"{changed} of {pixels} labelled pixels changed ({100 * changed / max(pixels, 1):.2f} %), "
        f"{amount(filled, 'view')} without a mask got one, in {run.seconds:.1f} s",
        *(f"{output / name}" for name in ("masks", "confidence", "classes.json", "report.json", "before_after.png")),
    ]


def _change(run: ReprojectedRun, index: int) -> dict[str, object]:
    given, voted = run.given[index], run.voted[index]
    known = None if given is None else given != IGNORE
    confidence = run.confidence[index].float() / 255.0
    return {
        "view": run.names[index],
        "labelled": 0 if known is None else int(known.sum()),
        "changed": 0 if known is None else int((known & (given != voted)).sum()),
        "mean_confidence": round(float(confidence.mean()), 4),
    }


def mask_paths(images: Sequence[Path]) -> list[Path]:
    """Return the masks' paths below their folder, where ``data.files.files_of_views`` finds them."""
    stems = Counter(image.stem for image in images)
    if len(images) == 1 or max(stems.values()) == 1:
        return [Path(f"{image.stem}.png") for image in images]
    root = Path(os.path.commonpath([image.parent for image in images]))
    return [image.relative_to(root).with_suffix(".png") for image in images]
