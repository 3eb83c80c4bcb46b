"""The stages between a trained base with masks and refinement (method, sections 2, 3 and 5)."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from beags_plugin.assignment.assignment import Assignment, by_largest
from beags_plugin.assignment.contributions import check_class_ids, contributions
from beags_plugin.core.cameras import Camera
from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE, objects_in
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.labels.label_maps import CompressedMaps, LabelMaps
from beags_plugin.masks import REPROJECTIONS
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.preparation.agreed import AgreementReport, agree
from beags_plugin.preparation.consistent_masks import (
    AUTO,
    ConsistentMasks,
    Stage,
    chosen_reprojection,
    left_out,
    masks_as_they_are,
    render_depths,
    reprojected_masks,
)
from beags_plugin.preparation.refiner import AssignedScene, Refiner
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import SURFACE_DEPTHS
from beags_plugin.system.errors import UserError, check_choice
from beags_plugin.system.filed_tensors import filed
from beags_plugin.system.progress import timed
from beags_plugin.system.wording import amount

if TYPE_CHECKING:
    from beags_plugin.options.stages import PreparationConfig

LEAST_K = 10  # Fewer neighbours would measure the noise of the depth rather than the distance of points.


def check_options(config: PreparationConfig) -> None:
    """Raise ``UserError`` for a value that a stage would refuse, hours before that stage."""
    REPROJECTIONS.check(config.reprojection, AUTO, "none")
    if config.reprojection not in (AUTO, "none"):
        REPROJECTIONS.get(config.reprojection)  # Another package's may fail to load.
    check_choice(config.depth, SURFACE_DEPTHS, "surface depth")
    if not config.tau >= 0:
        raise UserError(f"tau is {config.tau}: it must be 0 or more (inf counts every vote).")
    if not config.k >= 1:
        raise UserError(f"k is {config.k}: the voxel size needs at least 1 neighbour.")
    if not config.k_pixels >= 0:
        raise UserError(f"k_pixels is {config.k_pixels}: it must be a number of pixels, or 0 to take k as it is.")


def neighbours(config: PreparationConfig, cameras: Sequence[Camera]) -> int:
    """Return k for these training views, at least ``LEAST_K`` if it shrinks."""
    pixels = sum(camera.height * camera.width for camera in cameras)
    if config.k_pixels == 0 or pixels >= config.k_pixels:
        return config.k
    return min(config.k, max(round(config.k * pixels / config.k_pixels), LEAST_K))


@dataclass(frozen=True)
class Preparation:
    """Results of the stages.

    labels, confidence: per training view, see ``ConsistentMasks``.
    assignment: classes of the base.
    grid: the visibility voxel grids, or None if the refiner needs none.
    members: the Gaussians of each object, if the refiner decides more than the classes; else None.
    agreement: what agreement changed in the masks; None if they were not made to agree.
    summary: a line of text per stage. seconds: wall time per stage.
    """

    labels: LabelMaps
    confidence: CompressedMaps | None
    assignment: Assignment
    grid: VisibilityGrid | None
    members: Membership | None = None
    agreement: AgreementReport | None = None
    summary: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)


def prepare(
    surfels: Surfels,
    cameras: Sequence[Camera],
    labels: Sequence[Tensor | None],
    class_names: dict[int, str],
    rasterizer: Rasterizer,
    settings: RasterSettings,
    refiner: Refiner,
    config: PreparationConfig,
    background_voxels: bool = True,
    seed: int = 0,
    scale: float = 1.0,
    stage: Stage = lambda name: nullcontext(),
    photos: int | None = None,
) -> Preparation:
    """Make labels consistent, assign classes, build the voxel grids.

    surfels: the trained base, N Gaussians.
    cameras: V training views; labels: per view [H, W] int32 class ids or IGNORE, or None; held as ``LabelMaps``.
    class_names: id to name with background (0), in any range: the stages work on ranks.
    background_voxels: False drops the voxels of the background, for losses that ignore it.
    scale: units of the scene's frame per unit of the input poses'.
    photos: how many of the views, the first ones, are whole photos; close-ups of them follow. None: all.
    Depth images lie in temporary files, so memory grows by the compressed labels of a view and by voxels only. The
    exception is "pairwise", which reads depth and labels of all views into memory.
    Raises ``UserError`` if no mask names an object.
    """
    maps = labels if isinstance(labels, LabelMaps) else LabelMaps(labels)
    check_masks(maps)
    surfels = surfels.detach()
    known = known_classes(maps, class_names)
    summary: list[str] = []
    seconds: dict[str, float] = {}

    agreement, doubtful = None, None
    if config.agree:
        doubtful = CompressedMaps()
        with timed(seconds, "agreement"):
            maps, agreement = agree(
                surfels, cameras, maps, known, rasterizer, settings, stage,
                take=lambda _, mask: doubtful.append(mask.doubtful.to(torch.uint8)),
            )  # fmt: skip
            agreement = agreement.of_first(len(maps) if photos is None else photos)
        summary.append(f"agreement: {agreement.sentence()}")
    with timed(seconds, "reprojection"):
        masks = _consistent_masks(surfels, cameras, maps, known, rasterizer, settings, config, stage, summary, doubtful)
    with timed(seconds, "assignment"), stage("Assigning classes") as progress:
        shares = contributions(surfels, cameras, masks.ranked, rasterizer, settings, len(known), progress=progress)
        shares = replace(shares, classes=known)
        assignment = by_largest(shares)
    summary.append(_assignment_summary(assignment, class_names))

    scene = AssignedScene(
        surfels,
        assignment.class_ids,
        cameras,
        masks.labels,
        max(class_names) + 1,
        sorted(class_id for class_id in class_names if class_id != 0),
        rasterizer,
        settings,
        seed,
        shares,
        scale,
        config.depth,
        stage,
    )
    k = neighbours(config, cameras)

    start = time.perf_counter()
    with stage("Building voxel grids") as progress:
        grid = refiner.build_grid(scene, k, progress)
    if grid is not None:
        classes = torch.unique(assignment.class_ids)  # Classes are fixed: no loss looks up one without Gaussians.
        grid = grid.only(classes if background_voxels else classes[classes != 0])
        seconds["voxel grids"] = time.perf_counter() - start
        summary.append(f"voxel grids: voxel size {grid.voxel_size:.4g} (k = {k})")
    start = time.perf_counter()
    if (members := refiner.members(scene)) is not None:
        seconds["objects"] = time.perf_counter() - start
    return Preparation(masks.labels, masks.confidence, assignment, grid, members, agreement, summary, seconds)


def check_masks(labels: Iterable[Tensor | None]) -> None:
    """Raise ``UserError`` if no mask names an object; masks after the first that does are not read."""
    fault = "no training view has a mask"
    for mask in labels:
        if mask is not None:
            if objects_in(mask):
                return
            fault = "no mask of a training view names an object"
    raise UserError(
        f"{fault}: put id images into masks/<image name>.png, make them with beags masks make, or train the preset "
        "beags-base, which needs none."
    )


def _consistent_masks(
    surfels, cameras, maps: LabelMaps, known: ClassRanks, rasterizer, settings, config,
    stage: Stage, summary: list[str], doubtful: CompressedMaps | None,
) -> ConsistentMasks:  # fmt: skip
    """Return the labels of all views, reprojected unless that is off, and add lines to ``summary``.

    doubtful: per view [H, W] uint8, 1 for pixels that reprojection leaves unlabelled; None: there are none.
    """
    if config.reprojection == "none":
        summary.append("reprojection: off, masks used as they are")
        return masks_as_they_are(maps, cameras, known)
    method, why = chosen_reprojection(config.reprojection, cameras, maps)
    with stage("Rendering depth") as progress:
        rendered = render_depths(surfels, cameras, rasterizer, settings, config.depth, progress)
        depths = filed(rendered, surfels.means.device)
    with stage("Reprojecting masks") as progress:
        masks = reprojected_masks(depths, cameras, maps, known, replace(config, reprojection=method), progress)
    if doubtful is not None:
        masks = left_out(masks, doubtful, known)
    if why is not None:
        summary.append(why)
    summary.append(_reprojection_summary(maps, masks.labels))
    return masks


def _reprojection_summary(before: Sequence[Tensor | None], after: Sequence[Tensor]) -> str:
    """Describe the pixels that reprojection changed."""
    changed = pixels = filled = 0
    for old, new in zip(before, after, strict=True):  # The maps are compressed; one view at a time is unpacked.
        if old is None:
            filled += 1
        else:
            changed, pixels = changed + int((old != new).sum()), pixels + old.numel()
    return (
        f"reprojection: {changed} of {pixels} labelled pixels changed ({100 * changed / max(pixels, 1):.2f} %), "
        f"{amount(filled, 'view')} without a mask got one"
    )


def _assignment_summary(assignment: Assignment, class_names: dict[int, str]) -> str:
    """Describe the number of Gaussians of each class."""
    counts = torch.bincount(assignment.class_ids.long(), minlength=max(class_names) + 1)
    per_class = ", ".join(f"{name} {int(counts[index])}" for index, name in sorted(class_names.items()))
    return f"assignment: Gaussians per class: {per_class}; never seen: {int(assignment.never_seen.sum())}"


def known_classes(labels: Sequence[Tensor | None], class_names: dict[int, str]) -> ClassRanks:
    """Rank the named classes and the unnamed ids in labels; raise ``UserError`` for ids above the last named one."""
    named = ClassRanks(torch.tensor(sorted(class_names)))
    if named.trivial:
        return named  # The stages check the masks themselves.
    last = max(class_names)
    present = torch.zeros(last + 1, dtype=torch.bool)
    for index, mask in enumerate(labels):
        if mask is not None:
            check_class_ids(mask, index, last + 1)
            present[mask[mask != IGNORE].long().to(present.device)] = True
    return ClassRanks(torch.cat([named.ids, present.nonzero()[:, 0]]))
