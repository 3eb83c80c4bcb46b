"""Consistent labels of all views: depth of every view, then reprojection (method, section 2)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING

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
from beags_plugin.system.progress import each_view

if TYPE_CHECKING:
    from beags_plugin.options.stages import PreparationConfig

AUTO = "auto"  # It stands for pairwise up to the two limits, else for voxel.
PAIRWISE_PIXELS = 100_000_000  # Pixels of all views; pairwise holds 5 bytes for each, 0.5 GB.
PAIRWISE_PAIRS = 1_000_000_000  # Pairs of a voting pixel and a view; each takes 7 to 9 ns on one core at 256 x 192.

Stage = Callable[[str], AbstractContextManager[Progress | None]]
"""Opens a named stage and returns its progress callback, such as a progress bar."""


@dataclass(frozen=True)
class ConsistentMasks:
    """M' of V views, held compressed.

    ranked: ranks of the classes, for the stages. labels: class ids, for the losses; the same maps if ids are ranks.
    confidence: per view [H, W] uint8, the winner's share of the votes in steps of 1/255; None without reprojection.
    """

    ranked: LabelMaps
    labels: LabelMaps
    confidence: CompressedMaps | None


def chosen_reprojection(name: str, cameras: Sequence[Camera], labels: LabelMaps) -> tuple[str, str | None]:
    """Resolve "auto" for these views, with a line of reasons; any other name is returned with None.

    "auto" is pairwise, which is slightly more exact, as long as its memory (pixels) and its time (pairs) are small;
    else it is voxel, whose cost grows with neither.
    """
    if name != AUTO:
        return name, None
    sizes = [camera.height * camera.width for camera in cameras]
    voting = [size for size, mask in zip(sizes, labels.stored, strict=True) if mask is not None]
    pixels, pairs = sum(sizes), sum(voting) * len(cameras)
    chosen = "pairwise" if pixels <= PAIRWISE_PIXELS and pairs <= PAIRWISE_PAIRS else "voxel"
    return chosen, (
        f"reprojection {chosen}: {len(cameras)} views have {pixels / 1e6:.3g} million pixels, "
        f"{pairs / 1e9:.3g} billion pairs of a pixel and a view; pairwise is taken up to {PAIRWISE_PIXELS / 1e6:g} "
        f"million and {PAIRWISE_PAIRS / 1e9:g} billion"
    )


def masks_as_they_are(labels: LabelMaps, cameras: Sequence[Camera], known: ClassRanks) -> ConsistentMasks:
    """Return the labels without reprojection; a view without a mask is all IGNORE."""
    whole = LabelMaps(
        torch.full((camera.height, camera.width), IGNORE, dtype=torch.int32, device=camera.viewmat.device)
        if mask is None
        else mask
        for mask, camera in zip(labels, cameras, strict=True)
    )
    return ConsistentMasks(translated(whole, known, known.ranks), whole, None)


def reprojected_masks(
    depths: Sequence[Tensor],
    cameras: Sequence[Camera],
    masks: LabelMaps,
    known: ClassRanks,
    config: PreparationConfig,
    progress: Progress | None = None,
) -> ConsistentMasks:
    """Return the labels of all views, voted by the views with masks; one voted view is in memory at a time.

    depths: per view [H, W], depth of the surface, perhaps on disk. config: names a registered reprojection.
    """
    given = translated(masks, known, known.ranks)
    ranked, confidence = LabelMaps(), CompressedMaps()
    reproject = REPROJECTIONS.get(config.reprojection)
    for mask in reproject(depths, cameras, given, len(known), tau=config.tau, progress=progress):
        ranked.append(mask.labels)
        confidence.append((mask.confidence * 255.0 + 0.5).to(torch.uint8))
    if len(ranked) != len(cameras):
        raise ValueError(f"the reprojection {config.reprojection!r} gave {len(ranked)} masks for {len(cameras)} views")
    return ConsistentMasks(ranked, translated(ranked, known, known.class_ids), confidence)


def left_out(masks: ConsistentMasks, doubtful: CompressedMaps, known: ClassRanks) -> ConsistentMasks:
    """Return the masks without labels and confidence where ``doubtful``, per view [H, W] uint8, is not 0."""

    def cleared(maps: Sequence[Tensor], value: int) -> Iterator[Tensor]:
        for each, doubt in zip(maps, doubtful, strict=True):
            yield each.masked_fill(doubt.to(each.device) > 0, value)

    ranked = LabelMaps(cleared(masks.ranked, IGNORE))
    confidence = None if masks.confidence is None else CompressedMaps(cleared(masks.confidence, 0))
    return ConsistentMasks(ranked, translated(ranked, known, known.class_ids), confidence)


def translated(labels: LabelMaps, known: ClassRanks, table: Callable[[Tensor], Tensor]) -> LabelMaps:
    """Return the maps with ``table`` applied to all but IGNORE; the same maps if ranks are ids."""
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
    """Render the surface depth [H, W] of each view in turn: see ``rasterizers.rendering.surface_depth``."""

    @torch.no_grad()
    def render(index: int) -> Tensor:
        background = surfels.means.new_zeros(3)
        return surface_depth(
            rasterizer.rasterize(geometry_inputs(surfels), cameras[index], settings, background), depth
        )

    return each_view(len(cameras), render, progress)
