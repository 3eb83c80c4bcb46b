"""Inputs and results of scoring a labelled scene (method, section 8)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Literal

from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.evaluation.metrics import AGREEMENT, METRICS, CloseUpMetrics, MaskMetrics

MaskKind = Literal["extracted", "rendered"]
MASK_KINDS: tuple[MaskKind, ...] = ("extracted", "rendered")
"""extracted: the object rendered alone. rendered: the object's share of the whole scene."""
Kind = MaskKind | Literal["close_up"]
FIGURES: dict[Kind, tuple[str, ...]] = {
    "extracted": METRICS,
    "rendered": (*AGREEMENT, "covered"),
    "close_up": tuple(field.name for field in fields(CloseUpMetrics)),
}
"""Names of the metrics of each kind. Spill belongs to objects rendered alone, covered to the whole scene. close_up: the
object at the resolution of the photo's file, if that is larger than the training image."""
KINDS = tuple(FIGURES)
IMAGE_FIGURES = ("psnr", "psnr_fit", "psnr_shown", "shown", "psnr_objects", "ssim")
"""Metrics of whole images. psnr_fit: after the affine colour map that fits the photo best, one for each photo, clamped
to 0..1. psnr_shown: over the pixels whose surface some training photo shows; shown: their share. psnr_objects: over the
pixels of all objects, except those next to the background. psnr_shown and psnr_objects are taken after the colour map
if ``SceneMetrics.colors_fitted``."""


@dataclass(frozen=True)
class FullPhoto:
    """A photo at the resolution of its file. camera: camera of the whole photo.

    region: takes left, top, right and bottom, pixels; returns the camera and the image [h, w, 3], float in 0..1.
    """

    camera: Camera
    region: Callable[[tuple[int, int, int, int]], tuple[Camera, Tensor]]


@dataclass(frozen=True)
class EvalView:
    """One held-out view and its ground truth.

    image: [H, W, 3] float in 0..1, the photograph, or None. visible: [h, w] integer class ids or IGNORE, or None
    without masks; predictions are resized to it. silhouettes: object id to [h, w] bool, pixels that the object covers
    when nothing stands before it. visible_objects: object id to [h, w] bool, the visible part if only some objects were
    labelled; scored instead of ``visible``. unknown_silhouettes, unknown_visible: object id to [h, w] bool, pixels that
    may or may not belong to its silhouette or to its mask in ``visible_objects``; they are in neither and do not count.
    full: the photograph at the resolution of its file, if that is larger.
    """

    camera: Camera
    image: Tensor | None
    visible: Tensor | None = None
    silhouettes: Mapping[int, Tensor] | None = None
    name: str = ""
    visible_objects: Mapping[int, Tensor] | None = None
    unknown_silhouettes: Mapping[int, Tensor] | None = None
    unknown_visible: Mapping[int, Tensor] | None = None
    full: FullPhoto | None = None


@dataclass(frozen=True)
class ObjectMetrics:
    """The metrics of each kind; None if there was nothing to compare with."""

    extracted: MaskMetrics | None
    rendered: MaskMetrics | None
    close_up: CloseUpMetrics | None = None


@dataclass(frozen=True)
class MaskRecord:
    """One scored mask.

    kind: see ``KINDS``. view: index of the view. truth: "silhouette" or "visible".
    """

    kind: Kind
    class_id: int
    view: int
    truth: str
    metrics: MaskMetrics | CloseUpMetrics


@dataclass(frozen=True)
class ViewRecord:
    """Metrics of the image of one view: PSNR in dB (infinite for equal images) and SSIM; None without a photograph.

    The others: see ``IMAGE_FIGURES``; None if they are unknown or no pixel counts.
    """

    name: str
    psnr: float | None
    ssim: float | None
    psnr_shown: float | None = None
    shown: float | None = None
    psnr_objects: float | None = None
    psnr_fit: float | None = None


@dataclass(frozen=True)
class SceneMetrics:
    """The metrics of a scene over all its views.

    mean: mean over the scene, as the protocol defines it. objects: object id to the mean over its masks. psnr: dB, mean
    over the views with a photograph, infinite for equal images; None without any. Other ``IMAGE_FIGURES``: likewise.
    extracted_truth: "silhouette" (occlusion-free), "visible" (without the pixels where another object hides this one),
    "both", or None. masks, views: the single metrics behind these means. colors_fitted: see ``evaluate_scene``.
    """

    mean: ObjectMetrics
    objects: dict[int, ObjectMetrics]
    psnr: float | None
    extracted_truth: str | None
    ssim: float | None = None
    masks: tuple[MaskRecord, ...] = ()
    views: tuple[ViewRecord, ...] = ()
    psnr_shown: float | None = None
    shown: float | None = None
    psnr_objects: float | None = None
    psnr_fit: float | None = None
    colors_fitted: bool = False
