"""What is left of the error of extracted objects, by kind: python -m benchmarks.remaining_error RUN [RUN ...].

For runs of generated scenes, which have exact masks of everything: the wrong pixels of each object's silhouette in the
held-out views, before refinement (if a run has kept that) and after. Each wrong pixel is of the first kind that fits:

    unseen    missing surface that no training photo shows
    thin      missing from parts (and sharp corners) that an opening with a disc of 5 pixels takes away
    rim       within a pixel of the exact outline: too much or missing, where another object shows next to it
              ("rim, object") or not ("rim, ground")
    floater   a piece that hangs together with no pixel of the object
    contact   farther than a pixel from the outline, where another object shows within two pixels
    else      farther than a pixel from the outline, elsewhere: bulges and bites

Printed is each kind's share of the wrong pixels, and the points of BIoU that objects would win if its pixels were right
and all others as they are (these gains do not add up to the whole error).
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.system.errors import UserError, print_user_errors_plainly

KINDS = (
    "unseen",
    "thin",
    "rim, ground: too much",
    "rim, ground: missing",
    "rim, object: too much",
    "rim, object: missing",
    "floater",
    "contact",
    "else",
)
_THREE, _DISC = np.ones((3, 3), np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))


@dataclass(frozen=True)
class WrongMask:
    """One wrong mask: the number of wrong pixels and the gain of BIoU (0..1) of each kind; biou: as it is."""

    name: str
    biou: float
    pixels: dict[str, int]
    gains: dict[str, float]


def kinds_of(predicted: np.ndarray, exact: np.ndarray, seen: np.ndarray, others: np.ndarray) -> dict[str, np.ndarray]:
    """Return the wrong pixels of a mask by kind, in the order of ``KINDS``; no pixel is in two. All are [H, W] bool.

    seen: where training photos show the object's surface. others: where the view shows another object.
    """
    extra, missing = predicted & ~exact, exact & ~predicted
    left = extra | missing
    found = {}

    def take(kind: str, pixels: np.ndarray) -> None:
        nonlocal left
        found[kind] = left & pixels
        left = left & ~pixels

    take("unseen", missing & ~seen)
    take("thin", missing & (cv2.morphologyEx(exact.astype(np.uint8), cv2.MORPH_OPEN, _DISC) == 0))
    grown = _grown(exact)
    inner = cv2.erode(exact.astype(np.uint8), _THREE, borderValue=(0,)) > 0  # outside the picture is no mask
    rim = (extra & grown) | (missing & ~inner)
    next_to = _grown(others)
    take("rim, ground: too much", rim & extra & ~next_to)
    take("rim, ground: missing", rim & missing & ~next_to)
    take("rim, object: too much", rim & extra)
    take("rim, object: missing", rim & missing)
    _, pieces = cv2.connectedComponents(predicted.astype(np.uint8), connectivity=8)
    take("floater", predicted & ~np.isin(pieces, np.unique(pieces[predicted & grown])))
    take("contact", _grown(next_to))
    take("else", left)
    return found


def _grown(mask: np.ndarray) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), _THREE) > 0


def judged(
    name: str, predicted: np.ndarray, exact: np.ndarray, seen: np.ndarray, others: np.ndarray
) -> WrongMask | None:
    """Return what is wrong with a mask; arguments as of ``kinds_of``. None where both masks are empty."""
    from beags_plugin.evaluation.metrics import mask_metrics

    biou = mask_metrics(predicted, exact).biou
    if biou is None:
        return None
    kinds = kinds_of(predicted, exact, seen, others)
    righted = {kind: mask_metrics(predicted ^ pixels, exact).biou for kind, pixels in kinds.items()}
    return WrongMask(
        name,
        biou,
        {kind: int(pixels.sum()) for kind, pixels in kinds.items()},
        {kind: (1.0 if value is None else value) - biou for kind, value in righted.items()},  # None: both are empty
    )


def measure(config_path: Path) -> dict[str, list[WrongMask]]:
    """Return the judged masks of a run by stage; raises ``UserError`` for one without whole silhouettes."""
    import torch

    from beags_plugin.evaluation.protocol import Protocol
    from beags_plugin.evaluation.run_metrics import MaskRenderer
    from beags_plugin.objects.evaluate import EvaluatedRun

    run = EvaluatedRun(config_path)
    found: dict[str, list[WrongMask]] = {}
    for stage, scene in run.stages.items():
        if not scene.assigned:
            continue
        for view in run.views:
            if view.silhouettes is None or view.seen is None or view.visible is None:
                raise UserError(f"{run.name} lacks silhouettes, seen or masks in ground_truth: give a generated scene.")
            renderer = MaskRenderer(
                scene.surfels().detach(), scene.members, view, run.rasterizer, run.settings, Protocol()
            )
            with torch.no_grad():
                masks = renderer.masks("extracted", [c for c in run.classes if c != 0])
            for class_id, mask in masks.items():
                if class_id not in view.silhouettes or class_id not in view.seen:
                    raise UserError(f"{run.name} lacks masks of {run.classes[class_id]}: give a generated scene.")
                if mask.prediction.shape != mask.truth.shape:
                    raise UserError(f"{run.name} was trained on smaller photos: give a run of whole ones.")
                others = (view.visible != class_id) & (view.visible != 0) & (view.visible != IGNORE)
                judgement = judged(
                    run.classes[class_id],
                    mask.prediction.cpu().numpy(),
                    mask.truth.numpy(),
                    view.seen[class_id].numpy(),
                    others.numpy(),
                )
                if judgement is not None:
                    found.setdefault(stage, []).append(judgement)
    return found


def rows(stage: str, masks: Sequence[WrongMask]) -> Iterable[str]:
    """Yield rows of a table in Markdown: all objects, then each."""
    yield _row(f"{stage}: all", masks)
    for name in dict.fromkeys(mask.name for mask in masks):
        yield _row(f"{stage}: {name}", [mask for mask in masks if mask.name == name])


def _row(title: str, masks: Sequence[WrongMask]) -> str:
    wrong = max(sum(sum(mask.pixels.values()) for mask in masks), 1)
    cells = [
        f"{100 * sum(mask.pixels[kind] for mask in masks) / wrong:.0f}, "
        f"{100 * np.mean([mask.gains[kind] for mask in masks]):.1f}"
        for kind in KINDS
    ]
    return f"| {title} | {100 * np.mean([mask.biou for mask in masks]):.1f} | {' | '.join(cells)} |"


def main(arguments: Sequence[str]) -> None:
    """Print the table of the runs (config.yml, or the folders that hold one), pooled by stage."""
    if not arguments:
        sys.exit(__doc__)
    pooled: dict[str, list[WrongMask]] = {}
    for path in map(Path, arguments):
        for stage, masks in measure(path / "config.yml" if path.is_dir() else path).items():
            pooled.setdefault(stage, []).extend(masks)
    print(f"| share of wrong pixels, %; points of BIoU | BIoU | {' | '.join(KINDS)} |")
    print("|" + "---|" * (len(KINDS) + 2))
    for stage, masks in pooled.items():
        for row in rows(stage, masks):
            print(row)


if __name__ == "__main__":
    print_user_errors_plainly()
    main(sys.argv[1:])
