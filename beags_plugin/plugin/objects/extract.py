"""Extraction as runs: for each object a run folder of its own, and a .ply in the input's world frame (section 8)."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from beags_plugin.core.surfels import Surfels
from beags_plugin.extraction.ply import write_ply
from beags_plugin.extraction.select import remove_class, select_class
from beags_plugin.plugin.runs.checkpoint_file import check_state
from beags_plugin.plugin.runs.layout import (
    EXTRACTION_FILE,
    TRANSFORM_FILE,
    newest_checkpoint,
    prepared_digests,
    write_run,
    write_text_atomically,
)
from beags_plugin.plugin.runs.run_config import load_run_config
from beags_plugin.plugin.training.resumable import read_checkpoint
from beags_plugin.system.errors import UserError, writing
from beags_plugin.system.reading.text import load_json, reason

if TYPE_CHECKING:
    from beags_plugin.plugin.options.config import BeagsTrainerConfig


@dataclass(frozen=True)
class Extracted:
    """One extracted run: its name, the paths of its config.yml and .ply, and its number of Gaussians."""

    name: str
    config: Path
    ply: Path
    gaussians: int


@dataclass(frozen=True)
class SavedScene:
    """A trained run as it lies on disk: config, model state (tensors by name), step and class names."""

    config: BeagsTrainerConfig
    state: dict[str, Any]
    step: int
    classes: dict[int, str]

    def surfels(self) -> Surfels:
        """The scene's N surfels."""
        state = {name: self.state[f"gauss_params.{name}"] for name in ("means", "quats", "scales", "opacities")}
        dc, rest = self.state["gauss_params.features_dc"], self.state["gauss_params.features_rest"]
        return Surfels(state["means"], state["quats"], state["scales"], state["opacities"][:, 0], dc, rest)

    @property
    def assigned(self) -> bool:
        """Whether the Gaussians have classes."""
        return bool(self.state["assigned"])

    @property
    def class_ids(self) -> Tensor | None:
        """[N] int32, phi; None before the Gaussians have classes."""
        return self.state["class_ids"] if self.assigned else None


def read_scene(config_path: Path) -> SavedScene:
    """Read a run's newest checkpoint; raises ``UserError`` if the run is incomplete or the file is damaged."""
    config = load_run_config(config_path)
    path = newest_checkpoint(config.get_checkpoint_dir())
    checkpoint = read_checkpoint(path)
    prefix = "_model."
    state = {name[len(prefix) :]: value for name, value in checkpoint["pipeline"].items() if name.startswith(prefix)}
    check_state(state, path)
    return SavedScene(config, state, checkpoint["step"], state["_extra_state"]["classes"])


def load_scene(config_path: Path) -> SavedScene:
    """Read a run's newest checkpoint; raises ``UserError`` if the run is incomplete or no class was assigned."""
    scene = read_scene(config_path)
    if not scene.assigned:
        raise UserError(
            f"{config_path.parent} is a base without classes: refine it first "
            f"(ns-train beags-refine --load-dir {scene.config.get_checkpoint_dir()})."
        )
    return scene


def extract_objects(
    config_path: Path,
    objects: Sequence[str] = (),
    remove: bool = False,
    output: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Extracted]:
    """Write a run and a .ply per object.

    config_path: config.yml of a refined (or assigned) run. objects: names; none means every object that has Gaussians.
    remove: keep all but the object instead. output: folder for the runs; ``extracted/`` in the run by default.
    progress: is told (done, total) objects. Raises ``UserError`` for an unknown name, before anything is written.
    """
    scene = load_scene(config_path)
    run = config_path.parent
    class_ids = scene.state["class_ids"]
    ids = objects_with_gaussians(scene, objects, run)
    names = list(objects) or [name for name, index in ids.items() if index != 0]
    transform = read_transform(run)
    select = remove_class if remove else select_class
    folders, target = folder_names(scene.classes), output or run / "extracted"
    with writing(target):
        target.mkdir(parents=True, exist_ok=True)
    prepared = prepared_digests(run)  # tells whether the run was trained again later
    written = []
    for name in names:
        surfels, index = select(scene.surfels(), class_ids, ids[name])
        title = folders[ids[name]]
        title = f"without_{title}" if remove else title
        folder = target / title
        config = write_run(scene.config, folder, _rows(scene.state, index), scene.step)
        origin = {"object": name, "removed": remove, "run": str(config_path.absolute()), "prepared": prepared}
        write_text_atomically(json.dumps(origin, indent=2), folder / EXTRACTION_FILE)
        ply = folder / f"{title}.ply"
        write_ply(ply, surfels, class_ids[index], transform)
        written.append(Extracted(title, config, ply, len(surfels)))
        if progress is not None:
            progress(len(written), len(names))
    return written


def objects_with_gaussians(scene: SavedScene, objects: Sequence[str], run: Path) -> dict[str, int]:
    """Name to class id of all classes that have Gaussians; raises ``UserError`` if one of ``objects`` is none."""
    ids = {name: index for index, name in scene.classes.items()}
    if unknown := [name for name in objects if name not in ids]:
        raise UserError(f"there is no object {unknown[0]!r} in {run}: choose of {', '.join(ids)}.")
    present = {name: index for name, index in ids.items() if bool((scene.state["class_ids"] == index).any())}
    if absent := [name for name in objects if name not in present]:
        raise UserError(f"no Gaussian belongs to {absent[0]!r}: its masks cover too little of the scene.")
    return present


def _rows(state: dict[str, Any], index: Tensor) -> dict[str, Any]:
    """A model's state with the surfels ``index`` [M] only."""
    per_surfel = {"class_ids", "class_margin"}
    return {
        name: value[index] if name in per_surfel or name.startswith("gauss_params.") else value
        for name, value in state.items()
    }


def read_transform(run: Path) -> tuple[Tensor, float] | None:
    """The data parser's transform ([3, 4], scale) that a run was trained in; None if the run has not kept it.

    Raises ``UserError`` if the file is damaged.
    """
    path = run / TRANSFORM_FILE
    if not path.exists():
        return None
    try:
        content = load_json(path)
        transform, scale = torch.tensor(content["transform"], dtype=torch.float64), float(content["scale"])
        if transform.shape != (3, 4):
            raise ValueError(f"its transform is {list(transform.shape)}, not [3, 4]")
        if not (bool(transform.isfinite().all()) and math.isfinite(scale) and scale > 0):
            raise ValueError("it holds what is no number, or a scale that is not above 0")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} cannot be read ({reason(error)}): restore it.") from error
    return transform, scale


def folder_names(classes: dict[int, str]) -> dict[int, str]:
    """Class id to the name of its folder; where two would get the same one, the id follows."""
    plain = {index: file_name(name) for index, name in classes.items()}
    shared = Counter(name.lower() for name in plain.values())  # some file systems ignore case
    return {index: name if shared[name.lower()] == 1 else f"{name}_{index}" for index, name in plain.items()}


def file_name(name: str) -> str:
    """A class name as part of a path: anything unusual becomes an underscore."""
    return re.sub(r"[^\w.-]+", "_", name).strip("._") or "object"
