"""Source of masks without weights: GrabCut in a few views, carried to the others by the scene's depth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from beags_plugin.core.lifting import TAU
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.labels.label_maps import LabelMaps
from beags_plugin.masks.reprojection import reproject_pairwise
from beags_plugin.masks.sources.base import Geometry, MadeMasks, MaskSource, Progress, SourceScene, stacked
from beags_plugin.masks.sources.prompts import Prompt, PromptedObject, read_prompts
from beags_plugin.system.errors import UserError

_ITERATIONS = 5
_BAND = 0.012  # expected error of a carried outline, over the image diagonal
_MARGIN = 0.3  # background around an object that GrabCut sees, over the longer side of its box
PIECE = 0.1  # least size of a piece, over the largest one's; smaller pieces have the object's colours by chance
_POINT = 0.006  # radius of a prompted point, over the image diagonal


@dataclass(frozen=True)
class GrabCutSource(MaskSource):
    """GrabCut from boxes and points in a few views, and in the others from labels carried by the scene's depth.

    prompts: JSON, see ``prompts.read_prompts``. rounds: how often labels are carried; from the second round on all
    views vote, not only the prompted ones. tau: a vote counts if |z - depth| <= tau z. held_out: also make masks of
    held-out views, in the last round and without a vote; they are to look at, not to score against.
    """

    needs_run: ClassVar[bool] = True
    guesses: ClassVar[bool] = True

    prompts: Path = Path("prompts.json")
    rounds: int = 2
    tau: float = TAU
    held_out: bool = False

    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        assert scene.geometry is not None
        path = scene.below(self.prompts)
        objects = read_prompts(path)
        trained = {view for view in scene.places if scene.photos[view].trained}
        prompted = self._prompted(scene, objects, path)
        names = {0: "background", **{one.class_id: one.name for one in objects}}
        ids = sorted(one.class_id for one in objects)
        maps = self._carried(scene, trained, prompted, ids, progress)
        return MadeMasks(names, maps, [], frozenset(scene.places) - trained if self.held_out else frozenset())

    def _prompted(self, scene: SourceScene, objects: Sequence[PromptedObject], path: Path) -> dict[int, np.ndarray]:
        """Cut the labels of the prompted views, by photo index; a view needs prompts for all its objects."""
        masks_of: dict[int, list[tuple[int, np.ndarray]]] = {}
        for one in objects:
            if not one.prompts:
                raise UserError(f"{path} gives no prompt for {one.name}: GrabCut needs a box in two or three views.")
            for stem, prompt in one.prompts.items():
                view = scene.prompted_view(stem, path)
                if prompt.box is None:
                    raise UserError(f"{path} gives no box for {one.name} in {stem}: GrabCut needs one.")
                mask = cut_by_box(scene.photos[view].pixels(), prompt)
                masks_of.setdefault(view, []).append((one.class_id, mask))
        return {view: stacked(masks, masks[0][1].shape) for view, masks in masks_of.items()}

    def _carried(
        self,
        scene: SourceScene,
        trained: set[int],
        prompted: dict[int, np.ndarray],
        ids: list[int],
        progress: Progress,
    ) -> Iterator[np.ndarray | None]:
        geometry, places = scene.geometry, scene.places
        assert geometry is not None
        rounds, maps, done = max(1, self.rounds), dict(prompted), 0
        own = [index for index, view in enumerate(places) if view in trained]
        others = [index for index, view in enumerate(places) if self.held_out and view not in trained]
        total = len(own) * rounds + len(others)
        for number in range(rounds):
            chosen = own + others if number == rounds - 1 else own
            carried = carry(geometry, chosen, [maps.get(places[index]) for index in chosen], ids, self.tau)
            for index, (labels, sure) in zip(chosen, carried, strict=True):
                view = places[index]
                if view not in prompted:
                    start = geometry.to_photo(np.where(sure, labels, IGNORE).astype(np.uint16), index)
                    maps[view] = cut_from_labels(scene.photos[view].pixels(), start, ids)
                progress(done := done + 1, total)
        for view in range(len(scene.photos)):
            yield maps.get(view)


def carry(
    geometry: Geometry, views: Sequence[int], maps: Sequence[np.ndarray | None], ids: Sequence[int], tau: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Let the labels of some views of ``geometry`` vote on the labels of each of them.

    maps: labels of ``views`` with distortion, or None. Returns for each view labels [h, w] uint16 and whether more than
    half of the votes agree [h, w] bool, both without distortion.
    """
    known = ClassRanks(torch.tensor([0, *ids]))
    straight = LabelMaps()
    for view, labels in zip(views, maps, strict=True):
        ranks = None
        if labels is not None:
            labels = torch.from_numpy(geometry.to_straight(labels, view).astype(np.int32))
            ranks = torch.where(labels == IGNORE, labels, known.ranks(labels.masked_fill(labels == IGNORE, 0)))
        straight.append(ranks)
    depths = [geometry.depth(view) for view in views]
    cameras = [geometry.cameras[view] for view in views]
    carried = []
    for voted in reproject_pairwise(depths, cameras, straight, len(known), tau=tau):
        labels = voted.labels
        back = known.class_ids(labels.masked_fill(labels == IGNORE, 0)).masked_fill(labels == IGNORE, IGNORE)
        carried.append((back.numpy().astype(np.uint16), (voted.confidence > 0.5).numpy()))
    return carried


def cut_by_box(photo: np.ndarray, prompt: Prompt) -> np.ndarray:
    """Cut the object in the prompt's box, [H, W] bool; photo: [H, W, 3] uint8 RGB."""
    import cv2

    height, width = photo.shape[:2]
    assert prompt.box is not None
    left, top, right, bottom = (round(value) for value in prompt.box)
    left, top, right, bottom = max(left, 0), max(top, 0), min(right, width), min(bottom, height)
    if left >= right or top >= bottom:
        raise UserError(f"the box {list(prompt.box)} lies outside its image of {width}x{height} pixels: correct it.")
    start = np.full((height, width), cv2.GC_BGD, np.uint8)
    start[top:bottom, left:right] = cv2.GC_PR_FGD
    radius = max(2, round(_POINT * np.hypot(height, width)))
    for (x, y), inside in zip(prompt.points, prompt.inside, strict=True):
        cv2.circle(start, (int(x), int(y)), radius, (cv2.GC_FGD if inside else cv2.GC_BGD,), -1)
    return large_pieces(_cut(photo, start, (left, top, right, bottom)))


def cut_from_labels(photo: np.ndarray, labels: np.ndarray, ids: Sequence[int]) -> np.ndarray:
    """Cut each object from carried labels [H, W] uint16 (IGNORE: unknown) by GrabCut; return labels [H, W] uint16.

    Labels far from an outline stay; near outlines and in unknown areas, colours decide. An object stays within the
    convex hull of its labels and a band around it, as its colours may occur elsewhere.
    """
    import cv2

    height, width = labels.shape
    radius = max(2, round(_BAND * np.hypot(height, width)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    small = np.ones((3, 3), np.uint8)
    objects = []
    for class_id in ids:
        outside = (labels != class_id) & (labels != IGNORE)
        inside = large_pieces(cv2.morphologyEx((labels == class_id).astype(np.uint8), cv2.MORPH_OPEN, small) > 0)
        if not inside.any():
            continue
        left, top, wide, high = cv2.boundingRect(inside.astype(np.uint8))
        to_inside, to_outside = (
            cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) for mask in (inside, outside)
        )
        start = np.where(to_inside <= to_outside, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
        start[cv2.erode(inside.astype(np.uint8), disc) > 0] = cv2.GC_FGD
        start[cv2.erode(outside.astype(np.uint8), disc) > 0] = cv2.GC_BGD
        corners = cv2.convexHull(cv2.findNonZero(inside.astype(np.uint8)))
        hull = cv2.fillConvexPoly(np.zeros(labels.shape, np.uint8), corners, (1,))
        start[cv2.dilate(hull, disc, iterations=3) == 0] = cv2.GC_BGD  # places to which no view has carried the object
        objects.append((class_id, large_pieces(_cut(photo, start, (left, top, left + wide, top + high)))))
    return stacked(objects, (height, width))


def large_pieces(mask: np.ndarray) -> np.ndarray:
    """Return the connected pieces of a mask that have at least ``PIECE`` of the largest one's pixels, [H, W] bool."""
    import cv2

    _, pieces, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    large = 1 + np.flatnonzero(areas >= PIECE * areas.max(initial=0))
    return np.isin(pieces, large) & mask


def _cut(photo: np.ndarray, start: np.ndarray, box: tuple[int, int, int, int]) -> np.ndarray:
    """Apply GrabCut within the box and a margin around it; the rest is background."""
    import cv2

    height, width = start.shape
    left, top, right, bottom = box
    more = max(4, round(_MARGIN * max(right - left, bottom - top)))
    rows = slice(max(top - more, 0), min(bottom + more, height))
    columns = slice(max(left - more, 0), min(right + more, width))
    part = np.ascontiguousarray(start[rows, columns])
    mask = np.zeros((height, width), bool)
    kinds = np.isin(part, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if kinds.all() or not kinds.any():  # GrabCut needs both
        mask[rows, columns] = kinds
        return mask
    cv2.setRNGSeed(0)  # the k-means of its mixture models is random
    background, foreground = np.zeros((1, 65)), np.zeros((1, 65))
    image = np.ascontiguousarray(photo[rows, columns, ::-1])
    cv2.grabCut(image, part, (0, 0, 1, 1), background, foreground, _ITERATIONS, cv2.GC_INIT_WITH_MASK)
    mask[rows, columns] = np.isin(part, (cv2.GC_FGD, cv2.GC_PR_FGD))
    return mask
