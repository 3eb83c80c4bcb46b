"""Masks made consistent across views: depth of every view, then reprojection (method, section 2)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.labels.label_maps import CompressedMaps, LabelMaps
from beags_plugin.masks import REPROJECTIONS
from beags_plugin.preparation.refiner import Progress
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs, surface_depth
from beags_plugin.system.processes import each_view

AUTO = "auto"
PAIRWISE_PIXELS = 100_000_000
"""Up to so many pixels in all views "auto" is pairwise, which holds 5 bytes for each: 0.5 GB."""
PAIRWISE_PAIRS = 10_000_000_000
"""Up to so many pairs of a voting pixel and a view "auto" is pairwise: 7 to 9 ns each on one core at 256 x 192."""

Stage = Callable[[str], AbstractContextManager[Progress | None]]
"""Opens a named stage and gives its progress callback; a command line draws a bar with it."""


@dataclass(frozen=True)
class ConsistentMasks:
    """M' of V views.

    ranked: ranks of the classes, for the stages. labels: class ids, for the losses; the same maps where ids are ranks.
    confidence: per view [H, W] uint8, the winner's share of the votes in steps of 1/255; None: nothing was reprojected.
    All are held compressed.
    """

    ranked: LabelMaps
    labels: LabelMaps
    confidence: CompressedMaps | None


def chosen_reprojection(name: str, cameras: Sequence[Camera], labels: LabelMaps) -> tuple[str, str | None]:
    """The reprojection that ``name`` means for these views, and where that was chosen here, why: a line for a reader.

    "auto" is pairwise, which is a little more exact, where its memory (pixels) and its time (pairs) are small; else
    voxel, which grows with neither. Any other name means itself.
    """
    if name != AUTO:
        return name, None
    sizes = [camera.height * camera.width for camera in cameras]
    voting = [size for size, mask in zip(sizes, labels.stored, strict=True) if mask is not None]
    pixels, pairs = sum(sizes), sum(voting) * len(cameras)
    few = pixels <= PAIRWISE_PIXELS and pairs <= PAIRWISE_PAIRS
    return "pairwise" if few else "voxel", (
        f"reprojection {'pairwise' if few else 'voxel'}: {len(cameras)} views have {pixels / 1e6:.3g} million pixels, "
        f"{pairs / 1e9:.3g} billion pairs of a pixel and a view; pairwise is taken up to {PAIRWISE_PIXELS / 1e6:g} "
        f"million and {PAIRWISE_PAIRS / 1e9:g} billion"
    )


def masks_as_they_are(labels: LabelMaps, cameras: Sequence[Camera], known: ClassRanks) -> ConsistentMasks:
    """The masks without reprojection; a view that has none is all IGNORE."""
    whole = LabelMaps(_or_ignore(mask, camera) for mask, camera in zip(labels, cameras, strict=True))
    return ConsistentMasks(translated(whole, known, known.ranks), whole, None)


def reprojected_masks(
    depths: Sequence[Tensor],
    cameras: Sequence[Camera],
    labels: LabelMaps,
    known: ClassRanks,
    config,
    progress: Progress | None = None,
) -> ConsistentMasks:
    """The masks of all views, voted by those that have one.

    depths: per view [H, W], of the surface; they may lie on disk. config: a ``preparation.PreparationConfig`` whose
    reprojection is a registered one. Of what the votes give, one view is held at a time.
    """
    given = translated(labels, known, known.ranks)
    ranked, consistent, confidence = LabelMaps(), LabelMaps(), CompressedMaps()
    reproject = REPROJECTIONS.get(config.reprojection)
    found = reproject(depths, cameras, given, len(known), tau=config.tau, progress=progress)
    for mask in found:
        ranked.append(mask.labels)
        confidence.append((mask.confidence * 255.0 + 0.5).to(torch.uint8))
        if config.min_confidence > 0.0:
            # for the losses alone: the border split looks for the very rims that are doubtful
            doubtful = mask.confidence < config.min_confidence
            consistent.append(_translated(mask.labels, known.class_ids).masked_fill_(doubtful, IGNORE))
    if len(ranked) != len(cameras):
        raise ValueError(f"the reprojection {config.reprojection!r} gave {len(ranked)} masks for {len(cameras)} views")
    if config.min_confidence == 0.0:
        consistent = translated(ranked, known, known.class_ids)
    return ConsistentMasks(ranked, consistent, confidence)


def translated(labels: LabelMaps, known: ClassRanks, table: Callable[[Tensor], Tensor]) -> LabelMaps:
    """The maps with ``table`` of their values, IGNORE as it is; the same maps where ranks are ids."""
    return labels if known.trivial else LabelMaps(None if mask is None else _translated(mask, table) for mask in labels)


def _translated(mask: Tensor, table: Callable[[Tensor], Tensor]) -> Tensor:
    unlabelled = mask == IGNORE
    return table(mask.masked_fill(unlabelled, 0)).masked_fill_(unlabelled, IGNORE)


def render_depths(
    surfels: Surfels,
    cameras: Sequence[Camera],
    rasterizer: Rasterizer,
    settings: RasterSettings,
    depth: str,
    progress: Progress | None = None,
) -> Iterator[Tensor]:
    """Per view [H, W], the depth of the surface, drawn when it is asked for: see ``drawing.surface_depth``."""

    @torch.no_grad()
    def render(index: int) -> Tensor:
        background = surfels.means.new_zeros(3)
        drawn = rasterizer.rasterize(geometry_inputs(surfels), cameras[index], settings, background)
        return surface_depth(drawn, depth)

    return each_view(len(cameras), render, progress)


def _or_ignore(mask: Tensor | None, camera: Camera) -> Tensor:
    size, device = (camera.height, camera.width), camera.viewmat.device
    return mask if mask is not None else torch.full(size, IGNORE, dtype=torch.int32, device=device)
