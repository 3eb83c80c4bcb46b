"""Ground truth of the objects in a held-out view: the masks to compare with, and the pixels that count."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.evaluation.records import EvalView
from beags_plugin.labels.borders import at_border
from beags_plugin.labels.class_ids import IGNORE, resize_nearest


@dataclass(frozen=True)
class Truth:
    """The mask of an object in a view and pixels that may not count, all [h, w] bool.

    source: "silhouette" or "visible". unknown: pixels that do not count, or None. others: pixels that may belong to
    other objects and count unless their object hides this one, or None.
    """

    source: str
    mask: Tensor
    unknown: Tensor | None = None
    others: Tensor | None = None

    def compared(self) -> Tensor:
        """Return the mask with the unknown pixels, [h, w] bool, so that they make no boundary."""
        return self.mask if self.unknown is None else self.mask | self.unknown


def rendered_truth(view: EvalView, class_id: int) -> Truth | None:
    """Return the visible mask of an object; None if the view has no mask of it."""
    if view.visible_objects is not None:
        mask = view.visible_objects.get(class_id)
        return None if mask is None else Truth("visible", mask, _of(view.unknown_visible, class_id))
    return None if view.visible is None else Truth("visible", view.visible == class_id, view.visible == IGNORE)


def extracted_truth(view: EvalView, class_id: int) -> Truth | None:
    """Return the silhouette of an object in a view, else its visible mask; None if the view has no mask of it."""
    if view.silhouettes is not None and class_id in view.silhouettes:
        return Truth("silhouette", view.silhouettes[class_id], _of(view.unknown_silhouettes, class_id))
    visible = rendered_truth(view, class_id)
    if visible is None:
        return None
    if view.visible_objects is not None:
        return replace(visible, others=_of_others(view, class_id) & ~visible.mask)
    assert view.visible is not None
    return replace(visible, others=(view.visible != class_id) & (view.visible != 0) & (view.visible != IGNORE))


def resized(mask: Tensor, height: int, width: int) -> Tensor:
    """Return a mask [H, W] at another size by nearest pixel, on the CPU; the mask itself if it has that size."""
    if mask.shape == (height, width):
        return mask
    return torch.from_numpy(resize_nearest(mask.cpu().numpy(), height, width))


def object_pixels(view: EvalView) -> Tensor | None:
    """Return [H, W] bool, the pixels of the photograph inside the objects; None without masks.

    Pixels next to the background are left out, because they mix with it.
    """
    if view.visible_objects is not None:
        masks = list(view.visible_objects.values())
    else:
        masks = [] if view.visible is None else [(view.visible != 0) & (view.visible != IGNORE)]
    if not masks:
        return None
    inside = torch.stack([resized(mask, view.camera.height, view.camera.width) for mask in masks]).any(dim=0)
    return inside & ~at_border(inside.int())


def _of_others(view: EvalView, class_id: int) -> Tensor:
    """Return [h, w] bool: pixels that may belong to other objects, by their masks of the same size."""
    assert view.visible_objects is not None
    others = torch.zeros_like(view.visible_objects[class_id])
    for masks in (view.visible_objects, view.unknown_visible or {}):
        for other, mask in masks.items():
            if other != class_id and mask.shape == others.shape:
                others |= mask
    return others


def _of(masks: Mapping[int, Tensor] | None, class_id: int) -> Tensor | None:
    return None if masks is None else masks.get(class_id)
