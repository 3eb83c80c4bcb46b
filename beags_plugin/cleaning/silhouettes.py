"""Weights of an object's Gaussians inside and outside the masks of training views, with the object rendered alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import hides
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs, surface_depth

_INSIDE, _OUTSIDE, _HIDDEN, _BESIDE = range(4)


@dataclass(frozen=True)
class MaskedViews:
    """Training views of a whole scene, in its frame.

    cameras: without lens distortion. labels: per view [H, W] int32, the class ids or IGNORE after reprojection.
    depths: per view [H, W], the median depth of the whole scene, 0 where it is empty.
    """

    cameras: Sequence[Camera]
    labels: Sequence[Tensor]
    depths: Sequence[Tensor]
    rasterizer: Rasterizer
    settings: RasterSettings

    def evidence(self, part: Surfels, class_id: int) -> np.ndarray:
        """Return [M, 4] float64, weights of an object's Gaussians inside its masks, outside, hidden, and beside them.

        They are sums of w_i over the pixels of all views, the object rendered alone. Beside are pixels of other classes
        (the background too) next to the object's mask. Of the other pixels, hidden are those where the whole scene
        shows something nearer than the object, and outside the rest. Unlabelled pixels do not count.
        """
        total = np.zeros((len(part), 4))
        for view, places, _ in self._places(part, class_id):
            total += self._sums(part, view, places)
        return total

    def flips(self, part: Surfels, rest: Surfels, class_id: int) -> np.ndarray:
        """Return [M, 2] float64, the weights of an object's Gaussians at pixels that ``rest`` alone no longer covers.

        The first column is inside its masks (holes), the second outside, as in ``evidence``. A pixel is covered where
        alpha exceeds 1/2. part: M Gaussians. rest: some of them.
        """
        total = np.zeros((len(part), 4))
        for view, places, covered in self._places(part, class_id):
            render = self.rasterizer.rasterize(
                geometry_inputs(rest), self.cameras[view], replace(self.settings, geometry=False), _black(rest)
            )
            lost = covered & (render.alpha <= 0.5)
            if lost.any():
                total += self._sums(part, view, torch.where(lost, places, IGNORE))
        return total[:, :_HIDDEN]

    def _places(self, part: Surfels, class_id: int) -> Iterator[tuple[int, Tensor, Tensor]]:
        """Yield (view, [H, W] int32, the place of each pixel or IGNORE, [H, W] bool, where the part covers)."""
        inputs, settings = geometry_inputs(part), replace(self.settings, geometry=True, distortion=False)
        for view, (camera, labels, scene) in enumerate(zip(self.cameras, self.labels, self.depths, strict=True)):
            with torch.no_grad():
                render = self.rasterizer.rasterize(inputs, camera, settings, _black(part))
            own = labels == class_id
            hidden = hides(scene, surface_depth(render, "expected"))
            places = torch.full_like(labels, _OUTSIDE)
            places[hidden] = _HIDDEN
            places[_grown(own)] = _BESIDE
            places[labels == IGNORE] = IGNORE
            places[own] = _INSIDE
            yield view, places, render.alpha > 0.5

    def _sums(self, part: Surfels, view: int, places: Tensor) -> np.ndarray:
        """Return [M, 4] float64, the sums of w_i by place in one view."""
        settings = replace(self.settings, geometry=False, distortion=False)
        with torch.no_grad():
            sums = self.rasterizer.class_contributions(
                geometry_inputs(part), self.cameras[view], settings, places.int(), 4
            )
        return sums.double().cpu().numpy()


def _black(surfels: Surfels) -> Tensor:
    return surfels.means.new_zeros(3)


def _grown(mask: Tensor) -> Tensor:
    """Return a mask [H, W] bool with the eight pixels around each of its own."""
    return torch.nn.functional.max_pool2d(mask[None, None].float(), 3, stride=1, padding=1)[0, 0] > 0
