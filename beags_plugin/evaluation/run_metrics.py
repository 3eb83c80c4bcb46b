"""Scores of the objects that a labelled scene yields: extracted and rendered masks, PSNR, SSIM (method, section 8)."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.evaluation.metrics import MaskMetrics, mask_metrics, mean, mean_metrics, psnr
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import KINDS, EvalView, Kind, MaskRecord, ObjectMetrics, SceneMetrics, ViewRecord
from beags_plugin.extraction.select import select_class
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.losses.photometric import ssim
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs, surfel_inputs


def evaluate_scene(
    surfels: Surfels,
    class_ids: Tensor | None,
    rasterizer: Rasterizer,
    settings: RasterSettings,
    views: Sequence[EvalView],
    classes: Mapping[int, str],
    *,
    protocol: Protocol | None = None,
    complete: bool = True,
    background: Tensor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SceneMetrics:
    """Return Acc, IoU and BIoU of each object's extracted and rendered masks, PSNR and SSIM (method, section 8).

    surfels: N Gaussians. class_ids: [N] int32, phi; None scores images alone. classes: id to name; the background, 0,
    is not scored. complete: False where Gaussians were taken out of the scene, so that only extracted masks can be
    scored. background: [3] behind the images; black if None. progress: receives (done, total) views.
    """
    protocol = protocol or Protocol()
    surfels = surfels.detach()
    objects = [] if class_ids is None else sorted(class_id for class_id in classes if class_id != 0)
    settings = replace(settings, geometry=False, distortion=False)
    if background is None:
        background = surfels.means.new_zeros(3)
    masks: list[MaskRecord] = []
    images: list[ViewRecord] = []
    with torch.no_grad():
        for index, view in enumerate(views):
            renderer = MaskRenderer(surfels, class_ids, view, rasterizer, settings, protocol)
            for kind in KINDS if complete else KINDS[:1]:
                for class_id, mask in renderer.masks(kind, objects).items():
                    metrics = mask_metrics(mask.prediction, mask.truth, mask.ignore, protocol)
                    masks.append(MaskRecord(kind, class_id, index, mask.source, metrics))
            if complete and view.image is not None:
                inputs = surfel_inputs(surfels, view.camera)
                color = rasterizer.rasterize(inputs, view.camera, settings, background).color.clamp(0, 1)
                figures = psnr(color, view.image), float(ssim(color, view.image.to(color)))
            else:
                figures = None, None
            images.append(ViewRecord(view.name, *figures))
            if progress is not None:
                progress(index + 1, len(views))
    truths = {record.truth for record in masks if record.kind == "extracted"}

    def of_object(class_id: int, kind: Kind) -> MaskMetrics | None:
        return mean_metrics(r.metrics for r in masks if r.kind == kind and r.class_id == class_id)

    return SceneMetrics(
        mean=ObjectMetrics(*(average(masks, kind, protocol) for kind in KINDS)),
        objects={c: ObjectMetrics(*(of_object(c, kind) for kind in KINDS)) for c in objects},
        psnr=mean(image.psnr for image in images),
        extracted_truth="both" if len(truths) == 2 else next(iter(truths), None),
        ssim=mean(image.ssim for image in images),
        masks=tuple(masks),
        views=tuple(images),
    )


def average(masks: Iterable[MaskRecord], kind: Kind, protocol: Protocol, scene: Hashable = 0) -> MaskMetrics | None:
    """Return the mean of one kind of masks over a scene; None without any."""
    return pooled_average({scene: masks}, kind, protocol)


def pooled_average(
    scenes: Mapping[Hashable, Iterable[MaskRecord]], kind: Kind, protocol: Protocol
) -> MaskMetrics | None:
    """Return the mean of one kind of masks of several scenes, as if they were one scene; None without any."""
    groups: dict[Hashable, list[MaskMetrics]] = {}
    for scene, masks in scenes.items():
        for record in masks:
            if record.kind == kind:
                key = {"masks": 0, "objects": (scene, record.class_id), "views": (scene, record.view)}
                groups.setdefault(key[protocol.scene_average], []).append(record.metrics)
    return mean_metrics(mean_metrics(group) for group in groups.values())


@dataclass(frozen=True)
class RenderedMask:
    """A predicted mask [H, W] bool and its truth.

    truth: [h, w] bool. ignore: [h, w] bool, pixels that do not count, or None. source: "silhouette" or "visible".
    """

    prediction: Tensor
    truth: Tensor
    ignore: Tensor | None
    source: str


@dataclass(frozen=True)
class MaskRenderer:
    """The masks of a labelled scene in one view; fields as the arguments of ``evaluate_scene``."""

    surfels: Surfels
    class_ids: Tensor | None
    view: EvalView
    rasterizer: Rasterizer
    settings: RasterSettings
    protocol: Protocol

    def masks(self, kind: Kind, objects: Sequence[int]) -> dict[int, RenderedMask]:
        """Return object id to its mask, for those of ``objects`` that the view has a truth of."""
        if self.class_ids is None or not objects:
            return {}
        if kind == "rendered":
            known = {
                class_id: truth for class_id in objects if (truth := rendered_truth(self.view, class_id)) is not None
            }
            rendered = self._rendered(self.class_ids, list(known))
            return {c: RenderedMask(mask, *known[c], "visible") for c, mask in rendered.items()}
        found = {}
        for class_id in objects:
            if (truth := extracted_truth(self.view, class_id, self.protocol)) is not None:
                part = select_class(self.surfels, self.class_ids, class_id)[0]
                threshold = self.protocol.threshold
                mask = extracted_mask(part, self.view.camera, self.rasterizer, self.settings, threshold)
                found[class_id] = RenderedMask(mask, truth[1], truth[2], truth[0])
        return found

    def _rendered(self, class_ids: Tensor, objects: Sequence[int]) -> dict[int, Tensor]:
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
                colors[:, channel] = (class_ids == class_id).to(colors.dtype)
            colored = replace(inputs, colors=colors)
            value = self.rasterizer.rasterize(colored, self.view.camera, self.settings, black).color
            masks |= {c: value[..., channel] > self.protocol.threshold for channel, c in enumerate(triple)}
        return masks


def extracted_mask(
    part: Surfels, camera: Camera, rasterizer: Rasterizer, settings: RasterSettings, threshold: float
) -> Tensor:
    """Return [H, W] bool: A > threshold with the object's Gaussians ``part`` alone."""
    if len(part) == 0:
        return torch.zeros(camera.height, camera.width, dtype=torch.bool)
    black = part.means.new_zeros(3)
    return rasterizer.rasterize(geometry_inputs(part), camera, settings, black).alpha > threshold


def rendered_truth(view: EvalView, class_id: int) -> tuple[Tensor, Tensor | None] | None:
    """Return an object's visible mask, [h, w] bool, and the unlabelled pixels; None if the view has no mask of it."""
    if view.visible_objects is not None:
        truth = view.visible_objects.get(class_id)
        return None if truth is None else (truth, None)
    return None if view.visible is None else (view.visible == class_id, view.visible == IGNORE)


def extracted_truth(
    view: EvalView, class_id: int, protocol: Protocol | None = None
) -> tuple[str, Tensor, Tensor | None] | None:
    """Return the truth of an extracted object in a view; None if the view has no mask of it.

    That is (source, mask [h, w] bool, pixels to leave out [h, w] bool or None). source: "silhouette", or "visible",
    which leaves out pixels of other objects and IGNORE pixels.
    """
    if view.silhouettes is not None and class_id in view.silhouettes:
        silhouette = view.silhouettes[class_id]
        scored_whole = (protocol or Protocol()).silhouettes == "whole"
        known = None if scored_whole or view.seen is None else view.seen.get(class_id)
        return "silhouette", silhouette, None if known is None else silhouette & ~known
    if view.visible_objects is not None:
        truth = view.visible_objects.get(class_id)
        return None if truth is None else ("visible", truth, _of_others(view.visible_objects, class_id) & ~truth)
    if view.visible is None:
        return None
    return "visible", view.visible == class_id, (view.visible != class_id) & (view.visible != 0)


def _of_others(masks: Mapping[int, Tensor], class_id: int) -> Tensor:
    """Return [h, w] bool: pixels of the masks of other objects that have the size of this one's."""
    others = torch.zeros_like(masks[class_id])
    for other, mask in masks.items():
        if other != class_id and mask.shape == others.shape:
            others |= mask
    return others
