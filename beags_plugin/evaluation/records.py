"""Inputs and results of scoring a labelled scene (method, section 8)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.evaluation.metrics import (
    AGREEMENT,
    CLOSE_UP_METRICS,
    METRICS,
    REMOVAL_METRICS,
    CloseUpMetrics,
    MaskMetrics,
    RemovalMetrics,
)

MaskKind = Literal["extracted", "seen", "rendered"]
MASK_KINDS: tuple[MaskKind, ...] = ("extracted", "seen", "rendered")
"""extracted: the object rendered alone. seen: the same over the parts that training photos show, where the data says
which. rendered: the object's share of the whole scene."""
Kind = MaskKind | Literal["removal", "close_up"]
FIGURES: dict[Kind, tuple[str, ...]] = {
    "extracted": METRICS,
    "seen": METRICS,
    "rendered": (*AGREEMENT, "covered"),
    "removal": REMOVAL_METRICS,
    "close_up": CLOSE_UP_METRICS,
}
"""The names of the figures of each kind. Spill is of objects drawn alone, covered of the whole scene. removal: the
scene rendered without the object, where the data has an exact picture of that. close_up: the object at the size of the
photo's file, where that is larger than what is trained on."""
KINDS = tuple(FIGURES)
IMAGE_FIGURES = ("psnr", "psnr_fit", "psnr_shown", "shown", "psnr_objects", "ssim")
"""Of whole images. psnr_fit: after the affine map of colours that fits the photo best, one a photo, clamped to 0..1.
psnr_shown: over the pixels whose surface some training photo shows; shown: their share.
psnr_objects: over the pixels of any object but those next to the background. These two are taken after that map where
``SceneMetrics.colors_fitted`` says so."""


@dataclass(frozen=True)
class FullPhoto:
    """A photo at the size of its file. camera: of all of it.

    region: reads left, top, right and bottom, pixels; returns its camera and [h, w, 3] float in 0..1.
    """

    camera: Camera
    region: Callable[[tuple[int, int, int, int]], tuple[Camera, Tensor]]


@dataclass(frozen=True)
class EvalView:
    """One held-out view and its ground truth.

    image: [H, W, 3] float in 0..1, the photograph, or None. visible: [h, w] integer class ids or IGNORE, or None
    without masks; predictions are resized to it. silhouettes: object id to [h, w] bool, what the object covers when
    nothing stands before it. seen: object id to [h, w] bool, the part of the silhouette whose surface some training
    photo shows; metrics of the kind "seen" leave out the rest. visible_objects: object id to [h, w] bool, the visible
    part where single objects were labelled and nothing is known of the others; scored instead of ``visible``. removed:
    object id to [H, W, 3] float in 0..1, the exact picture without it. removed_shown: object id to [h, w] bool, the
    part of the silhouette where that picture shows surface which some training photo shows. unknown_silhouettes,
    unknown_visible: object id to [h, w] bool, the pixels of which cannot be told whether its silhouette, or its mask in
    ``visible_objects``, holds them; they are in neither and count nowhere. full: the photograph at the size of its
    file, where that is larger.
    """

    camera: Camera
    image: Tensor | None
    visible: Tensor | None = None
    silhouettes: Mapping[int, Tensor] | None = None
    name: str = ""
    seen: Mapping[int, Tensor] | None = None
    visible_objects: Mapping[int, Tensor] | None = None
    removed: Mapping[int, Tensor] | None = None
    removed_shown: Mapping[int, Tensor] | None = None
    unknown_silhouettes: Mapping[int, Tensor] | None = None
    unknown_visible: Mapping[int, Tensor] | None = None
    full: FullPhoto | None = None


@dataclass(frozen=True)
class ObjectMetrics:
    """The metrics of each kind; None where there was nothing to compare with."""

    extracted: MaskMetrics | None
    rendered: MaskMetrics | None
    seen: MaskMetrics | None = None
    removal: RemovalMetrics | None = None
    close_up: CloseUpMetrics | None = None


@dataclass(frozen=True)
class MaskRecord:
    """One scored mask, or object taken out.

    kind: see ``KINDS``. view: index of the view. truth: "silhouette" or "visible".
    """

    kind: Kind
    class_id: int
    view: int
    truth: str
    metrics: MaskMetrics | RemovalMetrics | CloseUpMetrics


@dataclass(frozen=True)
class ViewRecord:
    """The image of one view: its name, PSNR in dB (infinite for equal images) and SSIM; None without a photograph.

    The others: see ``IMAGE_FIGURES``; None where that is not known, or no pixel is such.
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
    """The figures of a scene over all its views.

    mean: over the scene, as the protocol says. objects: object id to the mean over its masks. psnr: dB, mean over the
    views with a photograph, infinite for equal images; None without any. Other ``IMAGE_FIGURES``: likewise.
    extracted_truth: "silhouette" (occlusion-free), "visible" (without the pixels where another object hides this one),
    "both", or None. masks, views: the single figures behind these means. colors_fitted: see ``evaluate_scene``.
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
