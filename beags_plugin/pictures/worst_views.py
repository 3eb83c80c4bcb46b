"""A picture of the worst masks: right, missed and wrong pixels over the photograph."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.evaluation.metrics import MaskMetrics, compared_masks
from beags_plugin.evaluation.records import EvalView, MaskKind
from beags_plugin.evaluation.report import RunMetrics, Stage
from beags_plugin.evaluation.run_metrics import MaskRenderer
from beags_plugin.pictures.cells import GAP, Square, as_bytes, below, beside, cell, crop, printable, square_around
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings

RIGHT, MISSED, WRONG, LEFT_OUT = 1, 2, 3, 4  # codes of an error map; 0 is outside of both masks
COLORS = {RIGHT: (0, 158, 115), MISSED: (0, 114, 178), WRONG: (213, 94, 0), LEFT_OUT: (150, 150, 150)}
"""RGB; also distinct for colour-blind people (Okabe and Ito)."""
_MEANINGS = {RIGHT: "right", MISSED: "missed", WRONG: "wrong", LEFT_OUT: "not scored"}
_KINDS: tuple[MaskKind, ...] = ("extracted", "rendered")
_SIDE = 240  # pixels of a cell
_LEGEND = 24  # pixels of the height of the legend
_GREY = 128  # takes the place of a missing photograph


@dataclass(frozen=True)
class WorstMask:
    """One mask and its errors.

    title: caption. photo: [h, w, 3] uint8, at the size at which masks are compared. errors: stage to its error map
    [h, w] uint8. metrics: stage to its metrics.
    """

    title: str
    kind: MaskKind
    photo: np.ndarray
    errors: Mapping[Stage, np.ndarray]
    metrics: Mapping[Stage, MaskMetrics]

    @property
    def score(self) -> float:
        """Return the IoU of the final state, by which masks are ranked."""
        value = self.metrics["after"].iou
        return 1.0 if value is None else value


def error_map(prediction: Tensor, truth: Tensor, ignore: Tensor | None) -> np.ndarray:
    """Return [h, w] uint8: RIGHT in both masks, MISSED in the truth only, WRONG in the prediction only, else 0.

    Pixels that do not count are LEFT_OUT. Arguments and size are those of ``metrics.compared_masks``.
    """
    predicted, true, counted = compared_masks(prediction, truth, ignore)
    errors = np.zeros(true.shape, dtype=np.uint8)
    errors[predicted & true] = RIGHT
    errors[~predicted & true] = MISSED
    errors[predicted & ~true] = WRONG
    errors[~counted] = LEFT_OUT
    return errors


def paint(photo: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Return the photo [h, w, 3] uint8, mixed by half with the colour of each error; 0 stays unchanged."""
    painted = photo.copy()
    for code, color in COLORS.items():
        there = errors == code
        painted[there] = (photo[there].astype(np.uint16) + color) // 2
    return painted


def worst_records(run: RunMetrics, kind: MaskKind, count: int) -> list[int]:
    """Return indices into ``run.after.masks`` of the ``count`` masks of a kind with the lowest IoU, worst first."""
    scored = [
        (metrics.iou, index)
        for index, mask in enumerate(run.after.masks)
        if mask.kind == kind and isinstance(metrics := mask.metrics, MaskMetrics) and metrics.iou is not None
    ]
    return [index for _, index in sorted(scored)[:count]]


def draw_worst(
    run: RunMetrics,
    scenes: Mapping[Stage, tuple[Surfels, Membership]],
    views: Sequence[EvalView],
    rasterizer: Rasterizer,
    settings: RasterSettings,
    count: int = 6,
    progress: Callable[[int, int], None] | None = None,
) -> list[WorstMask]:
    """Render the ``count`` worst masks of each kind again.

    run: the metrics of these scenes and views. scenes: stage to the Gaussians and their classes. progress: receives
    (done, total) masks.
    """
    names = run.names()
    masks = []
    chosen: list[tuple[MaskKind, int]] = [(kind, index) for kind in _KINDS for index in worst_records(run, kind, count)]
    with torch.no_grad():
        for kind, index in chosen:
            record = run.after.masks[index]
            view = views[record.view]
            errors: dict[Stage, np.ndarray] = {}
            for stage, (surfels, members) in scenes.items():
                renderer = MaskRenderer(surfels.detach(), members, view, rasterizer, settings, run.protocol)
                mask = renderer.masks(kind, [record.class_id])[record.class_id]
                errors[stage] = error_map(mask.prediction, mask.truth, mask.ignore)
            metrics: dict[Stage, Any] = {stage: scene.masks[index].metrics for stage, scene in run.stages().items()}
            photo = _photo(view, errors["after"].shape)
            title = f"{run.scene}, {view.name}: {names[record.class_id]}"
            masks.append(WorstMask(title, kind, photo, errors, metrics))
            if progress is not None:
                progress(len(masks), len(chosen))
    return masks


def _photo(view: EvalView, shape: tuple[int, ...]) -> np.ndarray:
    """Return the photograph at the size of the masks, [h, w, 3] uint8; grey without one."""
    from PIL import Image

    if view.image is None:
        return np.full((*shape, 3), _GREY, dtype=np.uint8)
    return np.asarray(Image.fromarray(as_bytes(view.image)).resize((shape[1], shape[0]), Image.Resampling.BILINEAR))


def worst_views_picture(masks: Sequence[WorstMask], count: int = 6) -> np.ndarray:
    """Return [H, W, 3] uint8: a legend, then the ``count`` worst masks of each kind, kinds beside each other.

    Each mask has a line with the photograph and the errors before and after refinement, in the same crop.
    Raises ``ValueError`` without masks.
    """
    if not masks:
        raise ValueError("a picture of the worst views needs at least one mask")
    blocks = []
    for kind in _KINDS:
        worst = sorted((mask for mask in masks if mask.kind == kind), key=lambda mask: mask.score)[:count]
        if worst:
            blocks.append(below([_heading(kind), *(_line(mask) for mask in worst)]))
    tallest = max(block.shape[0] for block in blocks)
    level = [np.pad(b, ((0, tallest - b.shape[0]), (0, 4 * GAP), (0, 0)), constant_values=255) for b in blocks]
    return below([_legend(), np.concatenate(level, axis=1)])


def _line(mask: WorstMask) -> np.ndarray:
    window = error_window(mask)
    size = (_SIDE, _SIDE)
    cells = [cell(crop(mask.photo, window, 255), size, mask.title)]
    for stage, errors in mask.errors.items():
        figures = mask.metrics[stage]
        caption = f"{stage}: IoU {_percent(figures.iou)}, BIoU {_percent(figures.biou)}"
        cells.append(cell(crop(paint(mask.photo, errors), window, 255), size, caption))
    return beside(cells)


def error_window(mask: WorstMask) -> Square:
    """Return the square around the object in truth and in every stage's prediction."""
    touched = [np.isin(errors, (RIGHT, MISSED, WRONG)) for errors in mask.errors.values()]
    return square_around(np.logical_or.reduce(touched))


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"


def _heading(kind: MaskKind) -> np.ndarray:
    meaning = {"extracted": "the object drawn alone", "rendered": "its share of the whole scene"}
    return _text(f"{kind} masks: {meaning[kind]}", 2)


def _legend() -> np.ndarray:
    """Return a picture of each colour beside its meaning."""
    entries = []
    for code, meaning in _MEANINGS.items():
        box = np.full((_LEGEND, _LEGEND, 3), 255, dtype=np.uint8)
        box[4:-4, 4:-4] = COLORS[code]
        entries += [box, _text(meaning, 0)]
    return np.concatenate(entries, axis=1)


def _text(text: str, left: int) -> np.ndarray:
    from PIL import Image, ImageDraw

    picture = Image.new("RGB", (left + 7 * len(text) + 12, _LEGEND), "white")
    ImageDraw.Draw(picture).text((left, 6), printable(text), fill="black")
    return np.asarray(picture)
