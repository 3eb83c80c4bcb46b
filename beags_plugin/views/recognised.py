"""Sentences for the user on how a scene's data were read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from beags_plugin.data.dataset import ColmapModel, Dataset, PoseTable, TransformsFile
from beags_plugin.data.files import unposed_note
from beags_plugin.system.wording import amount
from beags_plugin.views.poses import PosedViews


def recognised(parser: Any, scene: Dataset, views: PosedViews, metadata: Mapping[str, Any]) -> list[str]:
    """Return a line on how the data was read, and notes for the user."""
    stems = set().union(*views.stems)
    absent = [name for name in scene.split.held_out if name not in stems]
    notes = [
        f"The layout holds out {name}, but no image has that name: name the view with --held-out." for name in absent
    ]
    truth = metadata["ground_truth"] or {"visible": {}, "silhouettes": {}}
    if unknown := sorted({*truth["visible"], *truth["silhouettes"]} - set(metadata["classes"].values())):
        notes.append(
            f"Exact masks of {', '.join(map(repr, unknown))} do not count, as no class has that name: "
            f'name the classes in {scene.root / parser.config.classes_path}, {{"id": "name"}}.'
        )
    unposed = None if isinstance(scene.poses, PoseTable) else unposed_note(views.images)
    notes += [note for note in (metadata["stray_truth"], unposed) if note is not None]
    given = sum(mask is not None for mask in metadata["mask_filenames"])
    points = "random" if metadata["points3D_random"] else len(metadata["points3D_xyz"])
    line = (
        f"{scene.root}: {scene.layout} layout, poses of {_source(scene)}, {amount(len(views.images), 'image')} in "
        f"{views.images[0].parent.name} ({_split_in_words(parser, views, scene)}), "
        f"{amount(given, 'mask') if given else 'no masks'}, {points} seed points."
    )
    if scene.size_note and parser.config.downscale_factor in (None, scene.downscale):
        notes.append(scene.size_note)
    return [line, *views.notes, *notes]


def _split_in_words(parser: Any, views: PosedViews, scene: Dataset) -> str:
    if views.members is not None:
        return "splits named by the data"
    train, out = (parser.views_of_split(views, split) for split in ("train", "test"))
    if train == out:
        return "none held out"
    named = [name for name in scene.split.held_out if any(name in views.stems[i] for i in out)]
    also = f", {', '.join(named[:3])}{', ...' if len(named) > 3 else ''} by protocol" if named else ""
    return f"{len(out)} held out{also}"


def images_root(scene: Dataset) -> Path:
    """Return the folder below which images and masks have the same paths."""
    if isinstance(scene.poses, TransformsFile):
        return scene.poses.images or scene.root / "images"
    return scene.poses.images if isinstance(scene.poses, ColmapModel) else scene.poses.images[0].parent


def _source(scene: Dataset) -> str:
    poses = scene.poses
    file = poses.folder if isinstance(poses, ColmapModel) else poses.file
    return f"{file.relative_to(scene.root) if file.is_relative_to(scene.root) else file}"
