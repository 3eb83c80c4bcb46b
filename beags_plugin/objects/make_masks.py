"""``beags masks make``: write masks of a scene from a registered source as id images."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.surfels import Surfels
from beags_plugin.data.files import image_size, list_photos, photo_names
from beags_plugin.data.layout import fitting_layouts
from beags_plugin.data.orientation import as_stored
from beags_plugin.labels.classes import NO_TRUTH, check_names, read_id_mask, write_mask
from beags_plugin.masks.sources import MASK_SOURCES
from beags_plugin.masks.sources.base import MaskSource, NothingFound, Photo, SourceScene
from beags_plugin.objects.check_masks import check, options_beside, write_contradictions
from beags_plugin.objects.reproject_masks import ReprojectionOptions, data_to_reproject, mask_paths
from beags_plugin.pictures.cells import below, wrapped, write_picture
from beags_plugin.pictures.masks import tinted_cell
from beags_plugin.runs.run import Run
from beags_plugin.system.errors import UserError, check_choice, writing
from beags_plugin.system.progress import progress_bar
from beags_plugin.system.whole_files import write_whole
from beags_plugin.system.wording import amount
from beags_plugin.views.data_options import DataOptions
from beags_plugin.views.scene_data import SceneData


class RunGeometry:
    """The surfaces of a trained run at the size of the photos, for its training views, then for the others."""

    def __init__(self, run: Run) -> None:
        self.folder = run.folder
        self.run = run
        self.manager = data_to_reproject(self.run, ReprojectionOptions())
        self.images = list(self.manager.train_dataset.image_filenames)
        self.cameras = [view.camera for view in self.manager.views("train")]
        self._of_split: list[tuple[Literal["train", "eval"], int]] = [("train", i) for i in range(len(self.images))]
        held_out = zip(self.manager.eval_dataset.image_filenames, self.manager.views("eval"), strict=True)
        for index, (image, view) in enumerate(held_out):
            if image not in self.images:  # the training views serve as both if none is held out
                self._of_split.append(("eval", index))
                self.images.append(image)
                self.cameras.append(view.camera)
        self.rasterizer, self.settings = self.run.rasterizer, self.run.settings

    def surfels(self) -> Surfels:
        """Return the N Gaussians, in the run's frame."""
        return self.run.scene.surfels()

    def input_means(self) -> Tensor:
        """Return the centres of the Gaussians, [N, 3] float64, in the frame of the input poses."""
        transform, scale = self.run.transform or (torch.eye(3, 4, dtype=torch.float64), 1.0)
        means = self.surfels().means.detach().double().cpu()
        return (means / scale - transform[:, 3]) @ transform[:, :3]  # double precision, as the world may lie far from 0

    def to_straight(self, labels: np.ndarray, view: int) -> np.ndarray:
        split, index = self._of_split[view]
        return self.manager.files[split].undistorted(labels, index)

    def to_photo(self, labels: np.ndarray, view: int) -> np.ndarray:
        split, index = self._of_split[view]
        return self.manager.files[split].as_in_file(labels, index)


def configured_source(name: str, options: Sequence[str]) -> MaskSource:
    """Return a registered source with options "key=value"; raise ``UserError`` for an unknown key or a wrong value."""
    import tyro

    kind: Any = MASK_SOURCES.get(name)
    known = [field.name for field in fields(kind)]
    arguments = []
    for option in options:
        key, equals, value = option.partition("=")
        check_choice(key, known, "option", f" of the mask source {name}")
        if not equals:
            raise UserError(f"the option {option!r} of the mask source {name} has no value: give {option}=value.")
        if isinstance(getattr(kind, key, None), bool):
            if value not in ("true", "false"):
                raise UserError(f"the option {option!r} must be true or false.")
            arguments.append(f"--{'' if value == 'true' else 'no-'}{key.replace('_', '-')}")
        else:
            arguments += [f"--{key.replace('_', '-')}", *value.split(",")]
    try:
        source: MaskSource = tyro.cli(kind, args=arguments, console_outputs=False)
    except SystemExit:
        usual = ", ".join(f"{key}={getattr(kind, key)}" for key in known if hasattr(kind, key))
        raise UserError(
            f"the options {' '.join(options)} of the mask source {name} have a wrong value: the defaults are {usual}."
        ) from None
    if reason := source.unavailable():
        raise UserError(f"the mask source {name} cannot run: {reason}")
    return source


def make_masks(
    data: DataOptions,
    source: MaskSource,
    run: Run | None = None,
    output: Path | None = None,
    overwrite: bool = False,
    upright: bool = False,
) -> list[str]:
    """Write the masks of a scene: <output>/masks/<stem>.png, classes.json and made.png, a picture of them.

    The files replace the old masks of all views once all are made. data: names the scene. run: a run
    trained on it, for sources that need one. output: if None the scene's own folder, where ``beags-data`` looks for
    masks. overwrite: replace existing masks. upright: the source makes masks of the upright photos; they are turned to
    the photos as stored. Returns lines that report the written files and the findings of ``beags masks check``. Raises
    ``UserError``, before anything is written, for bad input.
    """
    root, images, trained, posed = _photos(data, source)
    folder = output or root
    masks, classes = folder / "masks", folder / "classes.json"
    there = [*masks.rglob("*.png"), *([classes] if classes.exists() else [])]
    if there and not overwrite:
        raise UserError(
            f"{folder} has masks or a classes.json already ({min(there).relative_to(folder)}): add --overwrite, or "
            "give another --output."
        )
    if source.needs_run and run is None:
        raise UserError(
            "this mask source needs a trained scene: train beags-base, then add --load-config <run>/config.yml."
        )
    sizes = [image_size(path) for path in images]
    photos = [
        Photo(name, path, *size, trained=index in trained)
        for index, (name, path, size) in enumerate(zip(photo_names(images), images, sizes, strict=True))
    ]
    if upright:
        if source.needs_run:
            raise UserError("this mask source uses the photos as they are stored: leave --upright out.")
        photos = [photo.upright() for photo in photos]
    geometry = RunGeometry(run) if run is not None and source.needs_run else None
    shares: list[float] = []
    pictured: list[tuple[Photo, Path]] = []
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with (
        writing(folder),
        TemporaryDirectory(prefix=".masks_", dir=folder) as temporary,
        progress_bar("Making masks") as progress,
    ):
        unfinished = Path(temporary) / masks.name
        made = source.make(SourceScene(root, photos, geometry), progress)
        check_names(made.names)
        for index, (path, labels) in enumerate(zip(mask_paths(images), made.maps, strict=True)):
            if labels is None:
                continue
            labels = as_stored(labels, photos[index].turned)
            file = unfinished / path
            file.parent.mkdir(parents=True, exist_ok=True)
            write_mask(file, labels)
            shares.append(float((labels != 0).mean()))
            pictured.append(
                (replace(photos[index], turned=1, width=labels.shape[1], height=labels.shape[0]), masks / path)
            )
        if not shares:
            raise UserError("the mask source gave no mask for any view: check its options.")
        if not any(shares):
            raise NothingFound(
                "the mask source found no object in any view: name another source, or check its options."
            )
        _replace_masks(unfinished, masks, {image.stem for image in images})
        (masks / NO_TRUTH).unlink(missing_ok=True)
        if source.guesses and not posed:
            (masks / NO_TRUTH).write_text(json.dumps({"made by": type(source).__name__}))
    names = {str(i): name for i, name in sorted(made.names.items())}
    write_whole(classes, lambda file: file.write(json.dumps(names, indent=1).encode()))
    _picture(folder / "made.png", pictured)
    checked: list[str] = []
    with suppress(UserError):  # training reports other errors; photos without poses cannot be checked
        given = data if run is None else options_beside(run, data.data, images_path=data.images_path)
        report = check(replace(given, masks_path=masks.absolute(), classes_path=classes.absolute()), run=run)
        checked = [*report.lines(), *(str(path) for path in write_contradictions(report, folder))]
    if not posed:
        checked = ["No photo has a pose yet, so all got masks."]
        if source.guesses:
            checked.append(f"{masks / NO_TRUTH} says that those of held-out views will be no truth to evaluate with.")
    return [
        *made.notes,
        f"{amount(len(shares), 'mask')} of {amount(len(photos), 'view')}, {amount(len(names) - 1, 'object')}, "
        f"{100 * np.mean(shares):.1f} % covered on average: {masks}",
        f"names: {classes}; look at {folder / 'made.png'}",
        *checked,
    ]


def _photos(data: DataOptions, source: MaskSource) -> tuple[Path, list[Path], set[int], bool]:
    """Return the scene's folder, its photos, which of them are for training, and whether they have poses."""
    root = Path(data.data).absolute()
    unposed = data.layout == "auto" and not source.needs_run and root.is_dir() and not fitting_layouts(root)
    if unposed and (photos := list_photos(root)):
        return root, photos, set(range(len(photos))), False
    parser = SceneData(data)
    scene, views = parser.posed_views()
    return scene.root, list(views.images), set(parser.views_of_split(views, "train")), True


def _replace_masks(unfinished: Path, masks: Path, stems: set[str]) -> None:
    """Move the new masks to ``masks``, and remove the old ones of images with these stems."""
    for old in list(masks.rglob("*.png")):
        if old.stem in stems:
            old.unlink()
    for new in sorted(unfinished.rglob("*.png")):
        place = masks / new.relative_to(unfinished)
        place.parent.mkdir(parents=True, exist_ok=True)
        new.replace(place)


def _picture(path: Path, pictured: Sequence[tuple[Photo, Path]]) -> None:
    """Draw the masks of at most 24 photos over these."""
    cells = []
    for photo, mask in pictured[:: -(-len(pictured) // 24)]:
        size = (260, max(1, round(260 * photo.height / photo.width)))
        cells.append([tinted_cell(photo.pixels(), read_id_mask(mask), size, photo.name)])
    write_picture(path, below(wrapped(cells, 1100)))
