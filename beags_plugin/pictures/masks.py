"""Pictures of masks: before and after reprojection, contradictions between views, coverage of each view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beags_plugin.labels.class_ids import IGNORE, resize_nearest
from beags_plugin.labels.colors import colorize
from beags_plugin.pictures.cells import GAP, below, beside, cell, wrapped, write_picture
from beags_plugin.system.errors import writing
from beags_plugin.system.reading.images import read_image

_WIDTH = 300  # pixels of the width of a cell
CHANGED = (255, 0, 255)
MARK = (255, 255, 0)


@dataclass(frozen=True)
class Changed:
    """One view: photo [H, W, 3] uint8; ids given (or None) and voted, [H, W]; confidence [H, W] uint8."""

    name: str
    photo: np.ndarray
    given: np.ndarray | None
    voted: np.ndarray
    confidence: np.ndarray


@dataclass(frozen=True)
class Pointed:
    """One view with N contradicted points: given [H, W] ids; places [N, 2] in 0..1; others: ids [N] in other views."""

    name: str
    photo: Path
    given: np.ndarray
    places: np.ndarray
    others: np.ndarray


def overlay(photo: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return a photo [H, W, 3] uint8 with its objects tinted (IGNORE grey) and its background unchanged."""
    tint = colorize(labels).astype(np.float32)
    return np.where((labels != 0)[..., None], 0.5 * photo + 0.5 * tint, photo).astype(np.uint8)


def tinted_cell(photo: np.ndarray, labels: np.ndarray, size: tuple[int, int], caption: str) -> np.ndarray:
    """Return the ``cell`` of a photo with its objects tinted; both are reduced first, which is quicker."""
    return cell(overlay(*_reduced(photo, labels, size)), size, caption)


def _reduced(photo: np.ndarray, labels: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Reduce a photo and its labels to (width, height) if they are wider; return both."""
    import cv2

    width, height = size
    if photo.shape[1] <= width:
        return photo, labels
    return cv2.resize(photo, size, interpolation=cv2.INTER_AREA), resize_nearest(labels, height, width)


def before_and_after(path: Path, views: Sequence[Changed], legend: str | None = None) -> None:
    """Write a picture with a line per view: mask before, mask after, changes, confidence.

    legend: meaning of the grey values, if they are not the share of the winning votes.
    """
    lines = []
    for view in views:
        marked = view.photo.copy()
        text = "no mask before"
        if view.given is not None:
            differs = (view.given != view.voted) & (view.given != IGNORE)
            marked[differs] = CHANGED
            text = f"changed: {100 * differs.mean():.2f} % of the view"
        before = view.photo if view.given is None else overlay(view.photo, view.given)
        grey = np.repeat(view.confidence[..., None], 3, axis=2)
        cells = [
            (before, f"{view.name}: before"),
            (overlay(view.photo, view.voted), "after"),
            (marked, text),
            (grey, legend or f"share of the winning votes, mean {view.confidence.mean() / 255:.3f}"),
        ]
        lines.append(beside([cell(image, _size(view.voted), caption) for image, caption in cells]))
    write_picture(path, below(lines))


def contradicted_picture(
    path: Path, pointed: Sequence[Pointed], framed: Sequence[tuple[Changed, Sequence[tuple[int, int, int, int]]]]
) -> None:
    """Write a picture of views that the others contradict.

    pointed: views drawn with dots at contradicted points, in the colours of the classes in other views (background:
    black). framed: views and their contradicted boxes; each mask is drawn beside the labels of the other views.
    """
    dotted, compared = [], []
    for view in pointed:
        size = _size(view.given, 2 * _WIDTH)
        photo = read_image(view.photo, lambda image: np.array(image.convert("RGB")))
        photo = overlay(*_reduced(photo, view.given, size))
        height, width, _ = photo.shape
        for place, color in zip(view.places, colorize(view.others), strict=True):
            _dot(photo, place * [width, height], color)
        caption = f"{view.name}: {len(view.places)} points in the colours of the other views"
        dotted.append([cell(photo, size, caption)])
    for view, boxes in framed:
        masks = [view.photo if view.given is None else overlay(view.photo, view.given), overlay(view.photo, view.voted)]
        for mask in masks:
            for box in boxes:
                _frame(mask, box)
        captions = (f"{view.name}: as given", "the other views")
        compared.append([cell(mask, _size(view.voted), text) for mask, text in zip(masks, captions, strict=True)])
    write_picture(path, below([line for cells in (dotted, compared) for line in wrapped(cells, 4 * (_WIDTH + GAP))]))


def _size(labels: np.ndarray, width: int = _WIDTH) -> tuple[int, int]:
    """Return width and height of a cell for a view with labels [H, W]."""
    return width, max(1, round(width * labels.shape[0] / labels.shape[1]))


def _dot(image: np.ndarray, place: np.ndarray, color: np.ndarray) -> None:
    import cv2

    center, radius = place.astype(int).tolist(), max(2, round(image.shape[1] / _WIDTH * 2))
    cv2.circle(image, center, radius + max(1, radius // 2), (255, 255, 255), -1)
    cv2.circle(image, center, radius, color.tolist(), -1)


def _frame(image: np.ndarray, box: tuple[int, int, int, int]) -> None:
    thick = max(1, round(image.shape[1] / _WIDTH))
    left, top, right, bottom = box
    top, left = max(top - thick, 0), max(left - thick, 0)
    image[top : top + thick, left:right] = image[bottom : bottom + thick, left : right + thick] = MARK
    image[top:bottom, left : left + thick] = image[top : bottom + thick, right : right + thick] = MARK


def coverage_picture(
    path: Path,
    stems: Sequence[str],
    ids: Sequence[int],
    names: Mapping[int, str],
    share: np.ndarray,
    usable: np.ndarray,
) -> None:
    """Write a picture of the share of each view that each object covers.

    share: [V, C], share of the view's pixels for each of ``ids``. usable: [V] bool; views without a mask are hatched.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    objects = [column for column, class_id in enumerate(ids) if class_id != 0]
    table = np.where(share[:, objects] > 0, 100.0 * share[:, objects], np.nan).T
    table[:, ~usable] = np.nan
    wide = min(max(6.0, 0.14 * len(stems) + 3.0), 40.0)
    figure = Figure(figsize=(wide, min(max(2.2, 0.3 * len(objects) + 1.6), 40.0)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_facecolor("white")
    finite = table[np.isfinite(table)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.1, 100.0)
    image = axes.imshow(
        table, aspect="auto", interpolation="nearest", cmap="viridis", norm=LogNorm(low, max(high, 1.001 * low))
    )
    for view in np.flatnonzero(~usable):
        axes.axvspan(view - 0.5, view + 0.5, facecolor="0.85", edgecolor="0.5", hatch="////", linewidth=0)
    axes.set_yticks(range(len(objects)), [f"{ids[column]} {names[ids[column]]}" for column in objects])
    step = max(1, len(stems) // 40)
    axes.set_xticks(range(0, len(stems), step), [stems[view] for view in range(0, len(stems), step)], rotation=90)
    axes.tick_params(labelsize=7)
    axes.set_title("Share of each view that an object covers (white: absent, hatched: no mask)", fontsize=9)
    figure.colorbar(image, ax=axes, label="% of the view")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110)
