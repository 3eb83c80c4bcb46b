"""Extract objects: a run folder and a .ply for each, in the frame of the input poses (method, section 8)."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from beags_plugin.cleaning.clean import LeftOut
from beags_plugin.core.membership import Membership
from beags_plugin.core.select import remove_class, select_class
from beags_plugin.objects.clean import cleaner_of
from beags_plugin.objects.shown import Shown
from beags_plugin.runs.checkpoint_file import exposures_of, extra_state
from beags_plugin.runs.layout import EXTRACTION_FILE, digest_of_prepared
from beags_plugin.runs.read import SavedScene
from beags_plugin.runs.run import Run
from beags_plugin.runs.write import write_run
from beags_plugin.splat_io.far_worlds import about, far_world_note, local_origin, to_world
from beags_plugin.splat_io.ply import write_ply
from beags_plugin.system.errors import UserError, check_choice, writing
from beags_plugin.system.whole_files import write_text_atomically


@dataclass(frozen=True)
class Extracted:
    """One extracted run.

    name: of the run's folder and .ply. config, ply: paths of its config.yml and .ply. gaussians: their number.
    left_out: Gaussians that were removed because they do not belong to the object; None if it was not cleaned.
    """

    name: str
    config: Path
    ply: Path
    gaussians: int
    left_out: LeftOut | None = None


def extract_objects(
    config_path: Path,
    objects: Sequence[str] = (),
    remove: bool = False,
    output: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    *,
    keep_all: bool = False,
    data: Path | None = None,
    say: Callable[[str], None] = lambda sentence: None,
) -> list[Extracted]:
    """Write a run and a .ply for each object; return them in order.

    config_path: config.yml of a run whose Gaussians have classes. objects: names; if empty, all objects that have
    Gaussians, but not the background. remove: write the scene without the object instead. output: folder for the runs;
    ``extracted/`` in the run by default. progress: receives (done, total) objects. keep_all: also keep Gaussians that
    do not belong to their object (``cleaning.clean``); ``remove`` removes them too. data: folder of the scene if it has
    moved. say: receives a sentence on map coordinates, and, if ``objects`` is empty, on objects without Gaussians.
    Raises ``UserError``, before anything is written, for an unknown name or an object without Gaussians.
    """
    opened = Run(config_path, data)
    scene, run = opened.assigned, opened.folder
    members = scene.members
    ids = objects_with_gaussians(scene, objects, run)
    names = list(objects) or [name for name, index in ids.items() if index != 0]
    transform = opened.transform
    amid = None if transform is None else local_origin(*transform)
    if transform is not None and amid is not None:
        transform = about(transform[0], amid), transform[1]
    select = remove_class if remove else select_class
    folders, target = folder_names(scene.classes), output or run / "extracted"
    with writing(target):
        target.mkdir(parents=True, exist_ok=True)
    cleaner = None if keep_all or remove else cleaner_of(Shown(opened))
    prepared = digest_of_prepared(run)  # shows later if the run was trained again
    written = []
    for name in names:
        surfels, index = select(scene.surfels(), members, ids[name])
        left_out = None
        if cleaner is not None:
            surfels, index, left_out = cleaner.clean(surfels, index, ids[name])
        part = members[index] if remove else Membership(torch.full((len(index),), ids[name], dtype=torch.int32))
        title = folders[ids[name]]
        title = f"without_{title}" if remove else title
        folder = target / title
        config = write_run(scene.config, folder, _rows(scene.state, index, part), scene.step)
        origin: dict[str, Any] = {"object": name, "removed": remove, "run": str(config_path.absolute())}
        origin |= {"prepared": prepared, "left_out": None if left_out is None else asdict(left_out)}
        write_text_atomically(json.dumps(origin, indent=2), folder / EXTRACTION_FILE)
        ply = folder / f"{title}.ply"
        write_ply(ply, surfels, part.class_ids, transform)
        if amid is not None:
            to_world(ply, amid)
        written.append(Extracted(title, config, ply, len(surfels), left_out))
        if progress is not None:
            progress(len(written), len(names))
    if amid is not None:
        say(far_world_note(amid, True, False))
    if not objects and (empty := {name: index for name, index in empty_objects(scene, run).items() if index != 0}):
        say(said_of_empty(empty, "extracted"))
    return written


def objects_with_gaussians(scene: SavedScene, objects: Sequence[str], run: Path) -> dict[str, int]:
    """Return {name: class id} of the classes with Gaussians; raise ``UserError`` if one of ``objects`` has none."""
    ids = {name: index for index, name in scene.classes.items()}
    for name in objects:
        check_choice(name, ids, "object", f" in {run}")
    there = set(scene.members.present())
    present = {name: index for name, index in ids.items() if index in there}
    if absent := [name for name in objects if name not in present]:
        raise UserError(f"no Gaussian belongs to {absent[0]!r}: its masks cover too little of the scene.")
    return present


def chosen_objects(scene: SavedScene, objects: Sequence[str], run: Path) -> dict[str, int]:
    """Return {name: class id} of ``objects`` in their order; if empty, of all objects that have Gaussians.

    Raises ``UserError`` for an object without Gaussians, and if there is none but the background.
    """
    present = objects_with_gaussians(scene, objects, run)
    chosen = objects or [name for name, class_id in present.items() if class_id != 0]
    if not chosen:
        raise UserError(f"{run} holds no object but the background: name another run, or --object background.")
    return {name: present[name] for name in chosen}


def empty_objects(scene: SavedScene, run: Path) -> dict[str, int]:
    """Return {name: class id} of the classes without Gaussians; empty for an extracted run, which holds few objects."""
    if (run / EXTRACTION_FILE).exists():
        return {}
    there = set(scene.members.present())
    return {name: index for index, name in scene.classes.items() if index not in there}


def said_of_empty(empty: Collection[str], done: str) -> str:
    """Return a sentence on objects without Gaussians. done: the verb, such as "extracted"."""
    names = ", ".join(map(repr, empty))
    return f"no Gaussian belongs to {names}: nothing is {done} of {'it' if len(empty) == 1 else 'them'}."


def _rows(state: dict[str, Any], index: Tensor, members: Membership) -> dict[str, Any]:
    """Return a model's state with only the Gaussians ``index`` [M] int64, and their classes."""
    rows = {
        name: value[index] if name == "class_margin" or name.startswith("gauss_params.") else value
        for name, value in state.items()
    }
    former = state["_extra_state"]
    extra = extra_state(former["classes"], members, exposures_of(former))
    return {**rows, "class_ids": members.class_ids, "_extra_state": extra}


def folder_names(classes: dict[int, str], taken: Collection[str] = ()) -> dict[int, str]:
    """Return {class id: name of its folder or files}; names are unique, also on file systems that ignore case.

    A name that two classes share, or that is ``taken``, gets the id appended, and a number if that is taken too.
    """
    plain = {index: file_name(name) for index, name in classes.items()}
    shared = Counter(name.casefold() for name in (*plain.values(), *taken))  # some file systems ignore case
    names, used = {}, set(shared)
    for index, name in plain.items():
        if shared[name.casefold()] > 1:
            longer = chain([f"{name}_{index}"], (f"{name}_{index}_{number}" for number in count(2)))
            name = next(each for each in longer if each.casefold() not in used)
            used.add(name.casefold())
        names[index] = name
    return names


def file_name(name: str) -> str:
    """Return a class name as part of a path: all but letters, digits and hyphens become underscores.

    Dots do too, as ``cup.compressed`` as .ply and ``cup`` as .compressed.ply would else be one file.
    """
    return re.sub(r"[^\w-]+", "_", name).strip("_") or "object"
