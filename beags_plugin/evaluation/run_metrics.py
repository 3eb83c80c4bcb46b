"""Scores of a labelled scene and its objects: masks, PSNR, SSIM (method, section 8)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from beags_plugin.core.color_fit import affine_color_fit, apply_affine
from beags_plugin.core.lifting import hides
from beags_plugin.core.membership import Membership
from beags_plugin.core.select import select_class
from beags_plugin.core.surfels import Surfels
from beags_plugin.evaluation.close_up import band_of, close_up, close_up_metrics
from beags_plugin.evaluation.metrics import covered, mask_metrics, mean, mean_metrics, psnr
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import (
    IMAGE_FIGURES,
    KINDS,
    MASK_KINDS,
    EvalView,
    Kind,
    MaskKind,
    MaskRecord,
    ObjectMetrics,
    SceneMetrics,
    ViewRecord,
)
from beags_plugin.evaluation.truths import (
    extracted_truth,
    object_pixels,
    rendered_truth,
    resized,
)
from beags_plugin.losses.photometric import ssim
from beags_plugin.rasterizers.interface import Rasterizer, RasterOutputs, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs, surface_depth, surfel_inputs


def evaluate_scene(
    surfels: Surfels,
    members: Membership | None,
    rasterizer: Rasterizer,
    settings: RasterSettings,
    views: Sequence[EvalView],
    classes: Mapping[int, str],
    *,
    protocol: Protocol | None = None,
    complete: bool = True,
    objects_alone: bool = False,
    colors_fitted: bool = False,
    background: Tensor | None = None,
    shown: Sequence[Tensor] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SceneMetrics:
    """Return the metrics of the masks of each object, and of the images (method, section 8).

    surfels: N Gaussians. members: their classes; None scores images only. classes: id to name; the background, 0, is
    not scored. complete: False if Gaussians were removed from the scene, so that only extracted masks can be scored.
    objects_alone: the scene was trained on objects only; only their pixels of images are scored. colors_fitted: the
    scene has learned exposures of photos; its colours are fitted to each photo by one affine map of the whole
    rendering, and PSNR shown and PSNR objects are taken after that. background: [3] behind the images; black if None.
    shown: per view [H, W] bool, see ``shown_pixels``. progress: receives (done, total) views.
    """
    protocol = protocol or Protocol()
    surfels = surfels.detach()
    objects = [] if members is None else sorted(class_id for class_id in classes if class_id != 0)
    settings = replace(settings, geometry=False, distortion=False)
    if background is None:
        background = surfels.means.new_zeros(3)
    masks: list[MaskRecord] = []
    images: list[ViewRecord] = []
    with torch.no_grad():
        for index, view in enumerate(views):
            renderer = MaskRenderer(surfels, members, view, rasterizer, settings, protocol)
            for kind in MASK_KINDS if complete else MASK_KINDS[:1]:
                for class_id, mask in renderer.masks(kind, objects).items():
                    metrics = mask_metrics(mask.prediction, mask.truth, mask.ignore, protocol)
                    if kind == "rendered":
                        hidden = covered(mask.prediction, mask.truth, mask.ignore)
                        metrics = replace(metrics, spill=None, covered=hidden)
                    masks.append(MaskRecord(kind, class_id, index, mask.source, metrics))
            image = ViewRecord(view.name, None, None)
            if complete and view.image is not None:
                color, photo = renderer.image(surfels, background), view.image.to(surfels.means)
                if (of_objects := object_pixels(view)) is not None:
                    of_objects = of_objects.to(color.device)
                # The rendering does not have the colours of the photo outside of objects that were trained alone.
                affine = affine_color_fit(color, photo, of_objects if objects_alone else None)
                if not objects_alone:
                    fitted = psnr(fitted_colors(color, affine), photo)
                    image = ViewRecord(view.name, psnr(color, photo), float(ssim(color, photo)), psnr_fit=fitted)
                if colors_fitted:
                    color = fitted_colors(color, affine).to(color)
                if of_objects is not None and of_objects.any():
                    image = replace(image, psnr_objects=psnr(color[of_objects], photo[of_objects]))
                if shown is not None and not objects_alone:
                    of_view = shown[index]
                    over = psnr(color[of_view], photo[of_view]) if of_view.any() else None
                    image = replace(image, psnr_shown=over, shown=float(of_view.double().mean()))
                for class_id in objects:
                    if not objects_alone and (part := close_up(view, class_id)) is not None:
                        near = MaskRenderer(surfels, members, part, rasterizer, settings, protocol)
                        mask, band = near.masks("extracted", [class_id])[class_id], band_of(view, protocol.band_share)
                        agreement = mask_metrics(mask.prediction, mask.truth, mask.ignore, protocol, band)
                        rendered = near.image(surfels, background)
                        if colors_fitted:  # The fit is that of the whole photo.
                            rendered = fitted_colors(rendered, affine).to(rendered)
                        metrics = close_up_metrics(part, class_id, rendered, agreement)
                        masks.append(MaskRecord("close_up", class_id, index, mask.source, metrics))
            images.append(image)
            if progress is not None:
                progress(index + 1, len(views))
    truths = {record.truth for record in masks if record.kind == "extracted"}

    def of_object(class_id: int, kind: Kind) -> Any:
        return mean_metrics(r.metrics for r in masks if r.kind == kind and r.class_id == class_id)

    return SceneMetrics(
        mean=ObjectMetrics(**{kind: mean_metrics(r.metrics for r in masks if r.kind == kind) for kind in KINDS}),
        objects={c: ObjectMetrics(**{kind: of_object(c, kind) for kind in KINDS}) for c in objects},
        extracted_truth="both" if len(truths) == 2 else next(iter(truths), None),
        masks=tuple(masks),
        views=tuple(images),
        colors_fitted=colors_fitted,
        **{name: mean(getattr(image, name) for image in images) for name in IMAGE_FIGURES},
    )


def fitted_colors(rendered: Tensor, affine: Tensor) -> Tensor:
    """Return a rendering [H, W, 3] under an affine colour map [3, 4], float64, clamped to 0..1."""
    return apply_affine(rendered.double(), affine).clamp(0, 1)


def psnr_after_fit(rendered: Tensor, photo: Tensor) -> float:
    """Return the PSNR in dB of a rendering after its best affine colour fit to the photo, clamped to 0..1.

    rendered, photo: [H, W, 3] float in 0..1. Differences in exposure or white balance alone do not count.
    """
    return psnr(fitted_colors(rendered, affine_color_fit(rendered, photo)), photo)


@dataclass(frozen=True)
class RenderedMask:
    """A predicted mask [H, W] bool and its truth [h, w] bool, a result of ``Truth.compared``.

    ignore: [h, w] bool, pixels that do not count, or None. source: as in ``Truth``.
    """

    prediction: Tensor
    truth: Tensor
    ignore: Tensor | None
    source: str


@dataclass(frozen=True)
class MaskRenderer:
    """The masks of a labelled scene in one view; fields as the arguments of ``evaluate_scene``."""

    surfels: Surfels
    members: Membership | None
    view: EvalView
    rasterizer: Rasterizer
    settings: RasterSettings
    protocol: Protocol
    _alone: dict[int, tuple[Tensor, Tensor | None]] = field(default_factory=dict)

    def image(self, surfels: Surfels, background: Tensor) -> Tensor:
        """Return an image [H, W, 3] in 0..1 of all or some of the scene's Gaussians."""
        camera = self.view.camera
        inputs = surfel_inputs(surfels, camera)
        return self.rasterizer.rasterize(inputs, camera, self.settings, background).color.clamp(0, 1)

    def masks(self, kind: MaskKind, objects: Sequence[int]) -> dict[int, RenderedMask]:
        """Return object id to its mask, for the objects of which the view has a truth."""
        if self.members is None or not objects:
            return {}
        if kind == "rendered":
            known = {c: truth for c in objects if (truth := rendered_truth(self.view, c)) is not None}
            rendered = self._rendered(self.members, list(known))
            return {
                c: RenderedMask(mask, known[c].compared(), known[c].unknown, "visible") for c, mask in rendered.items()
            }
        masks = {}
        for class_id in objects:
            if (truth := extracted_truth(self.view, class_id)) is not None:
                mask, hidden = self._extracted(self.members, class_id, truth.others)
                left_out = [pixels for pixels in (truth.unknown, hidden) if pixels is not None]
                ignore = torch.stack(left_out).any(dim=0) if left_out else None
                masks[class_id] = RenderedMask(mask, truth.compared(), ignore, truth.source)
        return masks

    def _extracted(self, members: Membership, class_id: int, others: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Return [H, W] bool, alpha of the object alone above the threshold, and the ``others`` that may hide it.

        Where the scene hides the object in a pixel of another one, the truth is unknown. The object is wrong
        there if it is rendered in front of the other one, inside it, or by the whole scene in its place.
        """
        if class_id not in self._alone:
            part = select_class(self.surfels, members, class_id)[0]
            camera, hidden = self.view.camera, None
            if len(part) == 0:
                return torch.zeros(camera.height, camera.width, dtype=torch.bool), None
            render = self._render(part, depth=others is not None)
            if others is not None:
                nearer = hides(self._scene_depth, surface_depth(render, "median"))
                nearer &= ~self._rendered(members, [class_id])[class_id]
                hidden = others & resized(nearer.cpu(), *others.shape)
            self._alone[class_id] = render.alpha > self.protocol.threshold, hidden
        return self._alone[class_id]

    @cached_property
    def _scene_depth(self) -> Tensor:
        """Return [H, W], the median depth of the whole scene, 0 without a surface."""
        return surface_depth(self._render(self.surfels, depth=True), "median")

    def _render(self, surfels: Surfels, depth: bool) -> RasterOutputs:
        inputs, settings = geometry_inputs(surfels), replace(self.settings, geometry=depth)
        return self.rasterizer.rasterize(inputs, self.view.camera, settings, surfels.means.new_zeros(3))

    def _rendered(self, members: Membership, objects: Sequence[int]) -> dict[int, Tensor]:
        """Return object id to [H, W] bool: value > threshold, with the object 1 and the rest of the scene 0, on black.

        Three objects share one rendering, one in each colour channel.
        """
        inputs = geometry_inputs(self.surfels)
        black = self.surfels.means.new_zeros(3)
        masks: dict[int, Tensor] = {}
        for first in range(0, len(objects), 3):
            triple = objects[first : first + 3]
            colors = torch.zeros_like(inputs.colors)
            for channel, class_id in enumerate(triple):
                colors[:, channel] = members.of(class_id).to(colors)
            colored = replace(inputs, colors=colors)
            value = self.rasterizer.rasterize(colored, self.view.camera, self.settings, black).color
            masks |= {c: value[..., channel] > self.protocol.threshold for channel, c in enumerate(triple)}
        return masks
