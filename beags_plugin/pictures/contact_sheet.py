"""One picture of a run: views beside renders, and every object alone before and after refinement."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.membership import Membership
from beags_plugin.core.select import select_class
from beags_plugin.core.surfels import Surfels
from beags_plugin.evaluation.records import EvalView
from beags_plugin.evaluation.truths import extracted_truth
from beags_plugin.labels.class_ids import IGNORE, resize_nearest
from beags_plugin.labels.colors import colorize
from beags_plugin.pictures.cells import Square, below, cell, checkerboard, crop, square_around, wrapped
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import surfel_inputs

_WIDTH = 1920  # pixels; a view of many objects goes on below
_FAINT = 0.1  # alpha from which a stray splat widens the crop
_SIDE = 220  # pixels of a cell


@dataclass(frozen=True)
class SheetRow:
    """One view of the sheet.

    photo, render: [H, W, 3] uint8; photo may be None. labels: [H, W] integer class ids or None. before, after: object
    id to [H, W, 4] uint8, the object alone with straight alpha. focus: object id to [H, W] bool, pixels that the crop
    must hold besides the object's.
    """

    name: str
    photo: np.ndarray | None
    labels: np.ndarray | None
    render: np.ndarray
    before: Mapping[int, np.ndarray]
    after: Mapping[int, np.ndarray]
    focus: Mapping[int, np.ndarray] = field(default_factory=dict)


def draw_rows(
    views: Sequence[EvalView],
    before: tuple[Surfels, Membership],
    after: tuple[Surfels, Membership],
    objects: Sequence[int],
    rasterizer: Rasterizer,
    settings: RasterSettings,
    *,
    novel: Camera | None = None,
    background: Tensor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[SheetRow]:
    """Render the views and one novel view, without gradients.

    before, after: the Gaussians with assignment alone and after refinement, and their classes. objects: ids to
    show alone. novel: its camera; left out if None. background: [3], black if None. progress: receives (done, total)
    views.
    """
    if novel is not None:
        views = [*views, EvalView(novel, None, name="novel view")]
    settings = replace(settings, geometry=False, distortion=False)
    if background is None:
        background = after[0].means.new_zeros(3)
    rows = []
    with torch.no_grad():
        for view in views:
            inputs = surfel_inputs(after[0].detach(), view.camera)
            render = _bytes(rasterizer.rasterize(inputs, view.camera, settings, background).color)
            size = render.shape[:2]
            truths = {c: extracted_truth(view, c) for c in objects}
            row = SheetRow(
                name=view.name,
                photo=None if view.image is None else _bytes(view.image),
                labels=None if view.visible is None else resize_nearest(view.visible.cpu().numpy(), *size),
                render=render,
                before={c: alone(*before, c, view.camera, rasterizer, settings) for c in objects},
                after={c: alone(*after, c, view.camera, rasterizer, settings) for c in objects},
                focus={c: resize_nearest(t.mask.cpu().numpy(), *size) for c, t in truths.items() if t is not None},
            )
            rows.append(row)
            if progress is not None:
                progress(len(rows), len(views))
    return rows


def novel_camera(views: Sequence[EvalView]) -> Camera | None:
    """Return the camera half-way between the first view and the one nearest to it; None for one view."""
    if len(views) < 2:
        return None
    first, *others = (view.camera for view in views)
    nearest = min(others, key=lambda camera: float((camera.center - first.center).norm()))
    return interpolate_cameras(first, nearest, 0.5)


def alone(
    surfels: Surfels,
    members: Membership,
    class_id: int,
    camera: Camera,
    rasterizer: Rasterizer,
    settings: RasterSettings,
) -> np.ndarray:
    """Return [H, W, 4] uint8: one object's Gaussians rendered alone, straight alpha."""
    part = select_class(surfels.detach(), members, class_id)[0]
    if len(part) == 0:
        return np.zeros((camera.height, camera.width, 4), dtype=np.uint8)
    render = rasterizer.rasterize(surfel_inputs(part, camera), camera, settings, part.means.new_zeros(3))
    alpha = render.alpha[..., None]
    # Under 1/255 alpha is written as 0, so the bound only keeps the quotient finite.
    return _bytes(torch.cat([render.color / alpha.clamp(min=1 / 255), alpha], dim=-1))


def _bytes(image: Tensor) -> np.ndarray:
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def interpolate_cameras(first: Camera, second: Camera, fraction: float) -> Camera:
    """Return the camera between two: centre and K linear, rotation along the shortest turn; the first one's image size.

    fraction: 0 gives the first camera, 1 the second's pose.
    """
    start, end = first.viewmat.double(), second.viewmat.double()
    turn = torch.matrix_exp(fraction * _rotation_log(end[:3, :3] @ start[:3, :3].T))
    rotation = turn @ start[:3, :3]
    center = torch.lerp(first.center.double(), second.center.double(), fraction)
    viewmat = torch.eye(4, dtype=torch.float64, device=start.device)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ center
    size_ratio = first.K.new_tensor([[first.width / second.width], [first.height / second.height], [1.0]])
    return Camera(
        viewmat.to(first.viewmat.dtype),
        torch.lerp(first.K, second.K * size_ratio, fraction),
        first.width,
        first.height,
    )


def _rotation_log(rotation: Tensor) -> Tensor:
    """Return the [3, 3] skew matrix whose exponential is ``rotation`` [3, 3]; zero for an (ambiguous) half turn."""
    skew = 0.5 * (rotation - rotation.T)
    sine = torch.stack([skew[2, 1], skew[0, 2], skew[1, 0]]).norm()
    if sine < 1e-9:  # angle 0 (or 180 degrees): angle / sine would be 0 / 0
        return torch.zeros_like(skew)
    return skew * (torch.atan2(sine, 0.5 * (rotation.trace() - 1)) / sine)


def contact_sheet(rows: Sequence[SheetRow], classes: Mapping[int, str]) -> np.ndarray:
    """Return [H, W, 3] uint8: the rows in one picture, with objects cropped alike before and after, and enlarged.

    classes: object id to name. A row that would be wider than a screen is wrapped. Raises ``ValueError`` without rows.
    """
    if not rows:
        raise ValueError("a contact sheet needs at least one row")
    masks = any(row.labels is not None for row in rows)
    return below([line for row in rows for line in wrapped(_groups(row, classes, masks), _WIDTH)])


def _groups(row: SheetRow, classes: Mapping[int, str], masks: bool) -> Iterator[list[np.ndarray]]:
    """Yield the cells of a row: photo, mask (if the sheet has ``masks``) and render; then the two of each object."""
    height, width = row.render.shape[:2]
    size = (max(1, round(_SIDE * width / height)), _SIDE)
    blank = np.full((height, width, 3), 255, dtype=np.uint8)
    photo = blank if row.photo is None else row.photo
    overlay = blank if row.labels is None else mask_overlay(photo, row.labels)
    mask = [cell(overlay, size, "mask" if row.labels is not None else "no mask")] if masks else []
    photo = cell(photo, size, f"{row.name}: photo" if row.photo is not None else row.name)
    yield [photo, *mask, cell(row.render, size, "render")]
    for class_id in sorted(row.before):
        name, window = classes.get(class_id, f"object {class_id}"), _window(row, class_id)
        stages = (("before", row.before[class_id]), ("after", row.after[class_id]))
        yield [cell(cut_out(image, window), (_SIDE, _SIDE), f"{name}, {stage}") for stage, image in stages]


def mask_overlay(photo: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return [H, W, 3] uint8: the photo in half its strength under the colours; background and IGNORE stay as they are.

    photo: [h, w, 3] uint8. labels: [H, W] integer class ids.
    """
    colors = colorize(labels)
    if photo.shape[:2] != labels.shape:
        photo = np.stack([resize_nearest(photo[..., i], *labels.shape) for i in range(3)], axis=-1)
    mixed = (photo.astype(np.uint16) + colors) // 2
    shown = (labels != 0) & (labels != IGNORE)
    return np.where(shown[..., None], mixed, photo).astype(np.uint8)


def _window(row: SheetRow, class_id: int) -> Square:
    """Return the square that holds the object before, after and in truth."""
    shown = np.zeros(row.render.shape[:2], dtype=bool)
    for image in (row.before[class_id], row.after[class_id]):
        shown |= image[..., 3] > 255 * _FAINT
    if class_id in row.focus:
        shown |= row.focus[class_id]
    return square_around(shown)


def cut_out(image: np.ndarray, window: Square) -> np.ndarray:
    """Return the window of an [H, W, 4] image, enlarged to a cell, over a checkerboard; uint8."""
    part = crop(image, window)
    large = np.stack([resize_nearest(part[..., i], _SIDE, _SIDE) for i in range(4)], axis=-1).astype(np.float64)
    board = checkerboard(_SIDE, _SIDE, 8)[..., None]
    alpha = large[..., 3:] / 255
    return (large[..., :3] * alpha + board * (1 - alpha)).round().astype(np.uint8)
