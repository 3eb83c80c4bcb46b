"""``beags masks agree``: masks that agree in space, by the Gaussians of a trained run."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import torch

from beags_plugin.data.files import image_size
from beags_plugin.labels.classes import write_mask
from beags_plugin.labels.label_maps import CompressedMaps, LabelMaps
from beags_plugin.masks.agreement import AgreedMask
from beags_plugin.objects.picked_masks import refinement_command
from beags_plugin.objects.reproject_masks import ReprojectionOptions, data_to_reproject, mask_paths
from beags_plugin.pictures.masks import Changed, before_and_after
from beags_plugin.preparation.agreed import agree
from beags_plugin.preparation.pipeline import check_masks, known_classes
from beags_plugin.runs.read import SavedScene
from beags_plugin.runs.run import Run
from beags_plugin.system.errors import UserError, writing
from beags_plugin.system.progress import counted, progress_bar
from beags_plugin.views.data_options import DataOptions

FOLDER = "agreed"  # the default output, beside config.yml
PICTURES = 6  # views in doubt.png
IN_DOUBT, CHANGED, AS_GIVEN = 0, 128, 255  # grey values in the last column of doubt.png
LEGEND = "black: in doubt, grey: changed"


def agree_masks(
    run: Run, options: ReprojectionOptions, output: Path | None = None, things: int = 1, enlarge: bool = False
) -> list[str]:
    """Write masks of all training views that agree, classes.json, report.json and doubt.png; return lines for users.

    run: any run, trained with or without masks. options: of the data; those of reprojection are
    not used. output: the folder; ``FOLDER`` beside config.yml if None. things: if above 1, the one object of the masks
    is split into at most so many separate things, which get its name and a number. enlarge: write masks made at the
    run's size at that of the photos, and name no next command. Raises ``UserError`` for a run or data that cannot be
    used, and if no mask of a training view names an object.
    """
    scene, manager = run.scene, data_to_reproject(run, options)
    views, files = manager.views("train"), manager.files["train"]
    with progress_bar("Reading masks", passing=True) as progress:
        given = LabelMaps(view.labels for view in counted(views, len(views), progress))
    check_masks(given)
    classes = manager.train_dataset.metadata["classes"]
    if things > 1 and len(classes) != 2:
        raise UserError(
            f"the masks name {len(classes) - 1} objects ({', '.join(classes[i] for i in classes if i)}), and only one "
            "can be split into separate things: leave --objects out."
        )
    doubts = CompressedMaps()

    def pixels(view: int) -> np.ndarray:
        return (255.0 * views[view].image + 0.5).to(torch.uint8).cpu().numpy()

    def take(view: int, mask: AgreedMask) -> None:
        value = torch.full_like(mask.labels, AS_GIVEN, dtype=torch.uint8)
        doubts.append(value.masked_fill(mask.changed, CHANGED).masked_fill(mask.doubtful, IN_DOUBT))

    labels, report = agree(
        scene.surfels().detach(), [view.camera for view in views], given, known_classes(given, classes),
        run.rasterizer, run.settings, progress_bar,
        1 if options.run_size else max(1, round(_downscale(scene))),
        [partial(pixels, view) for view in range(len(views))], take, things,
    )  # fmt: skip
    if report.things is not None:
        name = next(name for class_id, name in classes.items() if class_id)
        classes = {0: classes[0], **{i: f"{name} {i}" for i in range(1, report.things.found + 1)}}
    names, output = [view.name for view in views], output or run.folder / FOLDER
    with writing(output):
        for index, path in enumerate(mask_paths(manager.train_dataset.image_filenames)):
            (output / "masks" / path).parent.mkdir(parents=True, exist_ok=True)
            mask = files.as_in_file(labels[index].numpy().astype(np.uint16), index)
            if enlarge:
                size = image_size(manager.train_dataset.image_filenames[index])
                mask = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST_EXACT)
            write_mask(output / "masks" / path, mask)
        (output / "classes.json").write_text(json.dumps({str(i): name for i, name in classes.items()}, indent=1))
        (output / "report.json").write_text(json.dumps(report.to_json(names), indent=1))
        touched = np.add(report.changed, report.doubtful)
        order = [int(view) for view in np.argsort(-touched, kind="stable")[:PICTURES] if touched[view] > 0]
        pictured = []
        for view in order:
            before = None if (mask := given[view]) is None else mask.numpy()
            pictured.append(Changed(names[view], pixels(view), before, labels[view].numpy(), doubts[view].numpy()))
        (output / "doubt.png").unlink(missing_ok=True)
        if pictured:
            before_and_after(output / "doubt.png", pictured, LEGEND)
    written = ("masks", "report.json", *(["doubt.png"] if pictured else []))
    lines = [f"{report.sentence(names)}.", *(str(output / name) for name in written)]
    if report.things is not None and (sentence := report.things.sentence()):
        lines.insert(1, sentence)
    if enlarge:  # the demo goes on by itself
        return lines
    if options.run_size and _downscale(scene) != 1.0:
        return [*lines, "These masks are smaller than the photos: to train with masks, make them without --run-size."]
    return [*lines, f"Next: {_refinement(scene, output.absolute())}"]


def _downscale(scene: SavedScene) -> float:
    """Return the size of the photos over that at which the run was trained."""
    data = scene.config.data_config
    parser = cast(DataOptions, data.dataparser)
    return (parser.downscale_factor or 1.0) / data.camera_res_scale_factor


def _refinement(scene: SavedScene, output: Path) -> str:
    """Return the command that refines the run with the masks in ``output``."""
    parser = replace(
        cast(DataOptions, scene.config.data_config.dataparser), data=scene.config.data_path,
        downscale_factor=_downscale(scene), masks_path=output / "masks", classes_path=output / "classes.json",
    )  # fmt: skip
    return refinement_command(scene.config, parser)
