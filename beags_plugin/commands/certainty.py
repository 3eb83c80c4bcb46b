"""Judge how reliable the result of ``beags demo`` is, in words for its last lines and for summary.json."""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from beags_plugin.commands.answers import read_object
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.masks.separate_things import Things
from beags_plugin.system.pasted import quoted

SURE, FAIR = 0.9, 0.75  # Least agreement between the views for "sure" and "fairly sure".
MANY = 0.1  # With a larger share of masks overruled as a whole, the demo is not sure.
NAMED = 6  # Photos named in a sentence.
SMALL = 150  # An object whose longer side has fewer pixels shows no printed text.
PICTURES = 6  # Views in doubt.png.


@dataclass(frozen=True)
class Certainty:
    """A judgement of a demo's result.

    level: "sure", "fairly sure", "not sure", or "not judged" if no network made the masks. lines: sentences for the
    user, with what to do next. figures: the values behind them, for JSON.
    """

    level: str
    lines: list[str]
    figures: dict[str, Any] = field(default_factory=dict)


def certainty(
    run: Path, scene: Path, masks: Path | None = None, again: str = "beags demo --pick", apart: Path | None = None
) -> Certainty:
    """Judge a finished demo.

    run: its run. scene: the folder of its photos, with poses.json if poses were computed. masks: the folder of made
    masks, from which the user may delete some. again: the command with which the user picks the objects. apart: the
    folder of the masks of separated things, with the report on their agreement.
    """
    lines, figures = [], {}
    prepared = read_object(run / "prepared/report.json")
    agreement = read_object(apart / "report.json") if apart else prepared.get("agreement")
    level = "not judged" if agreement is None else _level(agreement)
    if agreement is not None:
        figures["agreement"] = {name: agreement[name] for name in ("agreement", "masks", "overruled", "doubtful")}
        lines.append(_of_masks(level, agreement))
    things = None if agreement is None or "things" not in agreement else Things(**agreement["things"])
    if things is not None:
        figures["things"] = asdict(things)
        lines += [things.sentence()] if things.sentence() else []
    poses = read_object(scene / "poses.json")
    if {"photos", "registered"} <= set(poses):
        without = int(poses["photos"]) - int(poses["registered"])
        figures["photos without poses"] = without
        if without:
            lines.append(f"{without} of {poses['photos']} photos have no pose and were left out.")
    if boxes := _boxes(run / "prepared/masks"):
        magnified = prepared.get("magnified", 1.0)
        width, height = (round(magnified * side) for side in np.median([box for _, box in boxes], axis=0))
        figures["object pixels"] = [width, height]
        finer = ": for more detail, add --downscale 1" if max(width, height) < SMALL and magnified == 1 else ""
        subject = "The object has" if len({class_id for class_id, _ in boxes}) == 1 else "Objects have"
        where = "close-ups" if magnified > 1 else "photos"
        lines.append(f"{subject} about {width} x {height} pixels in the {where} that training saw{finer}.")
    if agreement is not None and (level != "sure" or (things is not None and things.found < things.asked)):
        lines += _next(again, agreement, masks)
    return Certainty(level, lines, figures)


def _level(agreement: dict[str, Any]) -> str:
    overruled = len(agreement["overruled"]) / max(agreement["masks"], 1)
    if agreement["agreement"] < FAIR or overruled > MANY:
        return "not sure"
    return "sure" if agreement["agreement"] >= SURE and not overruled else "fairly sure"


def _of_masks(level: str, agreement: dict[str, Any]) -> str:
    line = f"How sure: {level}. The views agree on {100 * agreement['agreement']:.0f} % of what they call the object"
    if agreement["overruled"]:
        line += f"; {len(agreement['overruled'])} of {agreement['masks']} masks were overruled as a whole"
    return f"{line}; {100 * agreement['doubtful']:.1f} % of all pixels are in doubt and were left out."


def _next(again: str, agreement: dict[str, Any], masks: Path | None) -> list[str]:
    lines = ["If the object is not what you meant, pick it by a few clicks:", f"    {again} --fresh"]
    if masks is not None and agreement["overruled"]:
        names = [quoted(masks / f"{name}.png") for name in agreement["overruled"][:NAMED]]
        more = len(agreement["overruled"]) - len(names)
        others = f" ({more} more)" if more else ""
        lines += [f"Or delete the masks that contradict the others{others}, and run it again:",
                  f"    rm {' '.join(names)}"]  # fmt: skip
    return lines


def _boxes(masks: Path) -> list[tuple[int, tuple[int, int]]]:
    """Return the class, and width and height of the bounding box in pixels, of every object in every photo's mask."""
    from beags_plugin.labels.classes import read_id_mask
    from beags_plugin.views.close_ups import CLOSE_UPS

    boxes = []
    for path in sorted(path for path in masks.rglob("*.png") if path.relative_to(masks).parts[0] != CLOSE_UPS):
        labels = read_id_mask(path)
        for class_id in np.setdiff1d(labels, [BACKGROUND, IGNORE]).tolist():
            rows, columns = np.nonzero(labels == class_id)
            boxes.append((class_id, (int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1)))
    return boxes


def write_doubt(run: Path, path: Path, apart: Path | None = None) -> bool:
    """Write a picture of the views whose masks changed most; if none changed, remove an old one and return False.

    apart: the folder of the masks of separated things, with such a picture.
    """
    if apart is not None and (apart / path.name).exists():
        shutil.copyfile(apart / path.name, path)
        return True
    from beags_plugin.pictures.masks import Changed, before_and_after
    from beags_plugin.runs.prepared import training_masks
    from beags_plugin.runs.relocation import open_run
    from beags_plugin.system.reading.images import read_image

    agreement = read_object(run / "prepared/report.json").get("agreement") or {"views": []}
    shares = {each["view"]: each["changed"] + each["doubtful"] for each in agreement["views"]}
    worst = sorted((name for name in shares if shares[name] > 0), key=lambda name: -shares[name])[:PICTURES]
    if not worst:
        path.unlink(missing_ok=True)
        return False
    views = {each.name: each for each in training_masks(open_run(run / "config.yml"))}
    rows = []
    for name in worst:
        view = views[name]
        height, width = view.used.shape
        photo = read_image(view.photo, lambda image, size=(width, height): np.array(image.convert("RGB").resize(size)))
        changed = np.zeros(view.used.shape, bool) if view.given is None else view.given != view.used
        grey = np.where(view.used == IGNORE, 0, np.where(changed, 128, 255)).astype(np.uint8)
        rows.append(Changed(name, photo, view.given, view.used, grey))
    before_and_after(path, rows, "black: in doubt, grey: changed")
    return True
