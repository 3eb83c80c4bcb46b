"""What a labelled scene is scored with, and the figures that come of it (method, section 8)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.evaluation.metrics import MaskMetrics

Kind = Literal["extracted", "rendered"]
KINDS: tuple[Kind, ...] = ("extracted", "rendered")


@dataclass(frozen=True)
class EvalView:
    """One held-out view and what is known of it.

    camera: of the view. name: for tables and pictures.
    image: [H, W, 3] float in 0..1, the photograph, or None.
    visible: [h, w] integer class ids of what is seen, or IGNORE; None if there are no masks. May differ in size from
        the camera: predictions are resized to it.
    silhouettes: object id to [h, w] bool, what the object covers when nothing stands before it; None if unknown.
    seen: object id to [h, w] bool, the part of the silhouette whose surface some training photo shows; the rest
        cannot be known and is left out of the extracted metrics. None counts whole silhouettes.
    visible_objects: object id to [h, w] bool, what is seen of it, where single objects were labelled and nothing is
        known of the others; it is scored instead of ``visible``. None if there are no such masks.
    """

    camera: Camera
    image: Tensor | None
    visible: Tensor | None = None
    silhouettes: Mapping[int, Tensor] | None = None
    name: str = ""
    seen: Mapping[int, Tensor] | None = None
    visible_objects: Mapping[int, Tensor] | None = None


@dataclass(frozen=True)
class ObjectMetrics:
    """The two kinds of mask metrics; None where there was no mask to compare with."""

    extracted: MaskMetrics | None
    rendered: MaskMetrics | None


@dataclass(frozen=True)
class MaskRecord:
    """One scored mask.

    kind: extracted (the object drawn alone) or rendered (the object's share of the whole scene). class_id: of the
    object. view: index of the view. truth: what it was compared with, "silhouette" or "visible".
    """

    kind: Kind
    class_id: int
    view: int
    truth: str
    metrics: MaskMetrics


@dataclass(frozen=True)
class ViewRecord:
    """The image of one view: its name, PSNR in dB (infinite for equal images) and SSIM; None without a photograph."""

    name: str
    psnr: float | None
    ssim: float | None


@dataclass(frozen=True)
class SceneMetrics:
    """A scene's figures over all its views.

    mean: over the scene, as the protocol says. objects: object id to the mean over its masks.
    psnr: dB, mean over the views with a photograph; None if there is none; infinite for equal images. ssim: likewise.
    extracted_truth: what extracted masks were compared with: "silhouette" (occlusion-free), "visible" (the visible
        masks, without the pixels that other objects cover: what is behind them is unknown), "both", or None.
    masks, views: the single figures that these means are made of.
    """

    mean: ObjectMetrics
    objects: dict[int, ObjectMetrics]
    psnr: float | None
    extracted_truth: str | None
    ssim: float | None = None
    masks: tuple[MaskRecord, ...] = ()
    views: tuple[ViewRecord, ...] = ()
