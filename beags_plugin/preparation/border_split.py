"""Split the Gaussians at class boundaries before refinement (our extension of the method).

One Gaussian of the base may suffice for colour across a boundary of two classes, but it cannot form the straight edge.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.assignment.assignment import assign_classes
from beags_plugin.core.cameras import Camera
from beags_plugin.core.densification import Densified
from beags_plugin.core.splitting import split_in_two
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.borders import at_border
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.label_maps import LabelMaps
from beags_plugin.preparation.refiner import EditedScene
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs
from beags_plugin.system.errors import UserError

MIN_SHARE = 0.2  # least share of a split Gaussian's contributions that is at boundaries
MIN_SIGMA = 0.7  # pixels that the longer scale of a split Gaussian exceeds in its nearest view


@dataclass(frozen=True)
class BorderSplitConfig:
    """Options of splitting Gaussians in two, along their longer axis, before refinement."""

    rounds: int = 0
    """Times that Gaussians at class borders are split in two, before classes are assigned again; 0 in the paper."""

    def check(self) -> None:
        """Raise ``UserError`` for a negative number of rounds."""
        if self.rounds < 0:
            raise UserError(f"the border split has rounds = {self.rounds}: it must be 0 or more.")


def split_at_borders(
    surfels: Surfels,
    cameras: Sequence[Camera],
    labels: Sequence[Tensor],
    rasterizer: Rasterizer,
    settings: RasterSettings,
    num_classes: int,
    config: BorderSplitConfig,
    progress: Callable[[int, int], None] | None = None,
) -> EditedScene:
    """Split the Gaussians at boundaries of the labels ``config.rounds`` times and assign classes again.

    surfels: N Gaussians without gradients. labels: per camera M', [H, W] int32 ids below ``num_classes`` or IGNORE.
    """
    total, done = (config.rounds + 1) * len(cameras), 0

    def tick(*_: int) -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, total)

    bands = LabelMaps(at_border(mask).int().masked_fill_(mask == IGNORE, IGNORE) for mask in labels)
    edited = Densified.unchanged(surfels)
    for _ in range(config.rounds):
        share = _share_of_class(edited.surfels, cameras, bands, rasterizer, settings, tick)
        sigma = largest_sigma(edited.surfels, cameras)
        edited = edited.then(split_in_two(edited.surfels, (share >= MIN_SHARE) & (sigma > MIN_SIGMA)))
    assignment = assign_classes(edited.surfels, cameras, labels, rasterizer, settings, num_classes, tick)
    return EditedScene(edited, assignment)


def _share_of_class(surfels, cameras, bands, rasterizer, settings, tick) -> Tensor:
    """Return [N], the share of each Gaussian's contributions on pixels of value 1; 0 without contributions."""
    inputs = geometry_inputs(surfels)
    settings = replace(settings, geometry=False, distortion=False)
    total = torch.zeros(len(surfels), 2, dtype=torch.float64, device=surfels.means.device)
    for camera, band in zip(cameras, bands, strict=True):
        total += rasterizer.class_contributions(inputs, camera, settings, band, 2).double()
        tick()
    everything = total.sum(dim=1)
    return total[:, 1] / everything.masked_fill(everything <= 0, 1.0)


def largest_sigma(surfels: Surfels, cameras: Sequence[Camera]) -> Tensor:
    """Return [N], the longer scale face on in pixels of the view where it is largest; 0 behind all cameras."""
    per_length = torch.zeros_like(surfels.opacity_logits)
    for camera in cameras:
        depth = (surfels.means @ camera.rotation.T + camera.translation)[:, 2]
        pixels = camera.K[0, 0] / depth
        per_length = torch.where(depth > 0, torch.maximum(per_length, pixels), per_length)
    return surfels.log_scales.exp().amax(dim=1) * per_length
