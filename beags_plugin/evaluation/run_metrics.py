"""How well a labelled scene cuts out its objects: extracted and rendered masks, and PSNR (method, section 8)."""

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
    sh_degree: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SceneMetrics:
    """Extracted and rendered Acc, IoU and BIoU of each object, PSNR and SSIM.

    surfels: N surfels. class_ids: [N] int32, phi; None if there are none, so that only images are scored.
    classes: id to name; 0, the background, is not scored. complete: False where surfels were taken out of the scene,
    so that only objects drawn alone can be scored. background: [3] behind the images; black if None.
    sh_degree: of the colours; all if None. Empty masks count too. No gradients. Source: method, section 8.
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
            draw = MaskDrawing(surfels, class_ids, view, rasterizer, settings, protocol)
            for kind in KINDS if complete else KINDS[:1]:
                for class_id, mask in draw.masks(kind, objects).items():
                    metrics = mask_metrics(mask.prediction, mask.truth, mask.ignore, protocol)
                    masks.append(MaskRecord(kind, class_id, index, mask.source, metrics))
            image = view.image if complete else None
            images.append(
                _score_image(replace(view, image=image), surfels, rasterizer, settings, background, sh_degree)
            )
            if progress is not None:
                progress(index + 1, len(views))
    truths = {record.truth for record in masks if record.kind == "extracted"}
    return SceneMetrics(
        mean=ObjectMetrics(*(average(masks, kind, protocol) for kind in KINDS)),
        objects={c: ObjectMetrics(*(_object_mean(masks, kind, c) for kind in KINDS)) for c in objects},
        psnr=mean(image.psnr for image in images),
        extracted_truth="both" if len(truths) == 2 else next(iter(truths), None),
        ssim=mean(image.ssim for image in images),
        masks=tuple(masks),
        views=tuple(images),
    )


def _score_image(
    view: EvalView,
    surfels: Surfels,
    rasterizer: Rasterizer,
    settings: RasterSettings,
    background: Tensor,
    sh_degree: int | None,
) -> ViewRecord:
    if view.image is None:
        return ViewRecord(view.name, None, None)
    inputs = surfel_inputs(surfels, view.camera, sh_degree)
    color = rasterizer.rasterize(inputs, view.camera, settings, background).color.clamp(0, 1)
    return ViewRecord(view.name, psnr(color, view.image), float(ssim(color, view.image.to(color))))


def average(masks: Iterable[MaskRecord], kind: Kind, protocol: Protocol, scene: Hashable = 0) -> MaskMetrics | None:
    """The scene's mean of one kind of masks, as ``protocol.scene_average`` says; None without any."""
    return pooled_average({scene: masks}, kind, protocol)


def pooled_average(
    scenes: Mapping[Hashable, Iterable[MaskRecord]], kind: Kind, protocol: Protocol
) -> MaskMetrics | None:
    """The mean of one kind of masks of several scenes, as if they were one scene; None without any."""
    groups: dict[Hashable, list[MaskMetrics]] = {}
    for scene, masks in scenes.items():
        for record in masks:
            if record.kind == kind:
                key = {"masks": 0, "objects": (scene, record.class_id), "views": (scene, record.view)}
                groups.setdefault(key[protocol.scene_average], []).append(record.metrics)
    return mean_metrics(mean_metrics(group) for group in groups.values())


def _object_mean(masks: Iterable[MaskRecord], kind: Kind, class_id: int) -> MaskMetrics | None:
    return mean_metrics(r.metrics for r in masks if r.kind == kind and r.class_id == class_id)


@dataclass(frozen=True)
class DrawnMask:
    """A predicted mask [H, W] bool and what it is compared with.

    truth: [h, w] bool. ignore: [h, w] bool, pixels that do not count, or None. source: "silhouette" or "visible".
    """

    prediction: Tensor
    truth: Tensor
    ignore: Tensor | None
    source: str


@dataclass(frozen=True)
class MaskDrawing:
    """The masks of a labelled scene in one view; arguments as of ``evaluate_scene``."""

    surfels: Surfels
    class_ids: Tensor | None
    view: EvalView
    rasterizer: Rasterizer
    settings: RasterSettings
    protocol: Protocol

    def masks(self, kind: Kind, objects: Sequence[int]) -> dict[int, DrawnMask]:
        """Object id to its mask, for those of ``objects`` that the view has a truth of."""
        if self.class_ids is None or not objects:
            return {}
        view, drawing = self.view, (self.view.camera, self.rasterizer, self.settings, self.protocol.threshold)
        found = {}
        if kind == "extracted":
            for class_id in objects:
                if (truth := extracted_truth(view, class_id, self.protocol)) is not None:
                    part = select_class(self.surfels, self.class_ids, class_id)[0]
                    found[class_id] = DrawnMask(extracted_mask(part, *drawing), truth[1], truth[2], truth[0])
        else:
            truths = {class_id: truth for class_id in objects if (truth := rendered_truth(view, class_id)) is not None}
            for class_id, prediction in rendered_masks(self.surfels, self.class_ids, list(truths), *drawing).items():
                found[class_id] = DrawnMask(prediction, *truths[class_id], "visible")
        return found


def rendered_truth(view: EvalView, class_id: int) -> tuple[Tensor, Tensor | None] | None:
    """What is seen of an object, [h, w] bool, and the unlabelled pixels; None if the view has no mask of it."""
    if view.visible_objects is not None:
        truth = view.visible_objects.get(class_id)
        return None if truth is None else (truth, None)
    return None if view.visible is None else (view.visible == class_id, view.visible == IGNORE)


def extracted_truth(
    view: EvalView, class_id: int, protocol: Protocol | None = None
) -> tuple[str, Tensor, Tensor | None] | None:
    """What an extracted object is compared with in a view.

    Returns (kind, mask [h, w] bool, pixels to leave out [h, w] bool or None), or None if the view has no mask of it.
    kind: "silhouette", or "visible", where pixels of other objects and IGNORE pixels are left out.
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
    """[h, w] bool: pixels of the masks of other objects that are as large as this one's."""
    others = torch.zeros_like(masks[class_id])
    for other, mask in masks.items():
        if other != class_id and mask.shape == others.shape:
            others |= mask
    return others


def extracted_mask(
    part: Surfels, camera: Camera, rasterizer: Rasterizer, settings: RasterSettings, threshold: float
) -> Tensor:
    """[H, W] bool: A > threshold where only the object's surfels are drawn."""
    if len(part) == 0:
        return torch.zeros(camera.height, camera.width, dtype=torch.bool)
    black = part.means.new_zeros(3)
    return rasterizer.rasterize(geometry_inputs(part), camera, settings, black).alpha > threshold


def rendered_masks(
    surfels: Surfels,
    class_ids: Tensor,
    objects: Sequence[int],
    camera: Camera,
    rasterizer: Rasterizer,
    settings: RasterSettings,
    threshold: float,
) -> dict[int, Tensor]:
    """Object id to [H, W] bool: value > threshold of the whole scene with the object 1 and the rest 0, on black.

    Three objects share one drawing, one in each colour channel.
    """
    inputs = geometry_inputs(surfels)
    black = surfels.means.new_zeros(3)
    masks: dict[int, Tensor] = {}
    for first in range(0, len(objects), 3):
        triple = objects[first : first + 3]
        colors = torch.zeros_like(inputs.colors)
        for channel, class_id in enumerate(triple):
            colors[:, channel] = (class_ids == class_id).to(colors.dtype)
        value = rasterizer.rasterize(replace(inputs, colors=colors), camera, settings, black).color
        masks |= {class_id: value[..., channel] > threshold for channel, class_id in enumerate(triple)}
    return masks
