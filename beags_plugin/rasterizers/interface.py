"""The interface of a rasterizer: what every backend takes and returns (method, sections 1, 3, 4; E1 to E4, E6, E7)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import IGNORE

MIN_ALPHA = 1.0 / 255.0  # weaker contributions are skipped: they are invisible in 8 bits
LARGEST = 1e18  # world units; larger or more distant Gaussians count as broken: their squares overflow float32
MAX_ALPHA = 0.99  # keeps 1 - alpha, a divisor in the backward, away from 0
MIN_TRANSMITTANCE = 1e-4  # compositing stops before the Gaussian that would take T below this

FLOATS = ("means", "quats", "log_scales", "opacity_logits", "colors")
"""Fields of ``SurfelInputs`` that are never None, in the order in which kernels take them."""


@dataclass(frozen=True)
class RasterSettings:
    """The images to compute, and the scene's depth range.

    near, far: world units; they scale with the scene. Hits nearer than ``near`` are skipped. The distortion's depth
        mapping uses both: m(d) = far / (far - near) * (1 - near / d).
    geometry: whether to compute depth, median depth and normal; otherwise they are None and cost nothing.
    distortion: whether to compute the distortion.
    """

    near: float
    far: float
    geometry: bool = True
    distortion: bool = False


@dataclass(frozen=True)
class SurfelInputs:
    """N Gaussians to render for one view, with one colour each; all floats of one dtype (float32 or float64).

    means [N, 3], quats [N, 4] wxyz, log_scales [N, 2], opacity_logits [N]: as in ``core.surfels.Surfels``.
    colors: [N, 3] RGB as seen from this view.
    class_ids: [N] int32, phi, or None; needed with ``target``.
    screen_shift: [N, 2] zeros, or None: a shift of each disc (not of its low-pass filter) across the screen, in halves
        of the image's width and height. It stays zero; growth of the base uses its gradient, as the official code does.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    colors: Tensor
    class_ids: Tensor | None = None
    screen_shift: Tensor | None = None

    def detached(self) -> SurfelInputs:
        """Return the same Gaussians without gradients and ``screen_shift``."""
        return SurfelInputs(*(getattr(self, name).detach() for name in FLOATS), class_ids=self.class_ids)

    def to(self, dtype: torch.dtype) -> SurfelInputs:
        """Return the same Gaussians with all floats in another precision."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        changed = {name: value.to(dtype) for name, value in values.items() if name != "class_ids" and value is not None}
        return replace(self, **changed)

    def checked(self) -> SurfelInputs:
        """Return the same Gaussians, contiguous; raises ``ValueError`` for a field of a wrong shape or dtype."""
        n, dtype = self.means.shape[0], self.means.dtype
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"means must be float32 or float64, not {dtype}")
        shapes = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 2), "opacity_logits": (n,), "colors": (n, 3)}
        if self.screen_shift is not None:
            shapes["screen_shift"] = (n, 2)
        scattered = []
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape or value.dtype != dtype:
                raise ValueError(f"{name} must be {list(shape)} {dtype}, not {list(value.shape)} {value.dtype}")
            if not value.is_contiguous():
                scattered.append(name)
        if self.class_ids is not None:
            ids = self.class_ids
            if ids.shape != (n,) or ids.dtype != torch.int32:
                raise ValueError(f"class_ids must be [{n}] int32, not {list(ids.shape)} {ids.dtype}")
            if not ids.is_contiguous():
                scattered.append("class_ids")
        return replace(self, **{name: getattr(self, name).contiguous() for name in scattered}) if scattered else self


def map_ids(inputs: SurfelInputs, num_classes: int) -> Tensor:
    """Return the class ids [N] int32 for a class map; raises ``ValueError`` if one is not in 0..num_classes - 1."""
    ids = inputs.class_ids
    if ids is None:
        raise ValueError("class_ids must be given for a class map")
    if ids.numel() and not (int(ids.min()) >= 0 and int(ids.max()) < num_classes):
        raise ValueError(f"class_ids must lie in 0..{num_classes - 1}, not {int(ids.min())}..{int(ids.max())}")
    return ids


@dataclass(frozen=True)
class RasterOutputs:
    """The images of one view (E4). H and W are the camera's height and width; floats have the inputs' dtype.

    color: [H, W, 3] sum_i w_i c_i + T_end * background.
    alpha: [H, W] A = sum_i w_i.
    depth: [H, W] expected depth sum_i w_i d_i / A, world units along z; 0 where A = 0. None without ``geometry``.
    median_depth: [H, W] depth of the hit at which T passes 0.5; 0 where it never does. That hit alone has a gradient.
    normal: [H, W, 3] sum_i w_i n_i in camera space, turned towards the camera (so n . p <= 0); not normalised.
    distortion: [H, W] sum_{j<i} w_i w_j (m_i - m_j)^2, or None.
    boundary: [H, W] B(u) = sum_i w_i [phi_i != M'(u)], 0 at IGNORE (E7), or None without a target.
    visible: [N] bool, which Gaussians survive culling and reach a tile; growth of the base counts these as seen.
    num_nonfinite: number of Gaussians dropped because a parameter is not finite, or they are too large or too far.
    """

    color: Tensor
    alpha: Tensor
    depth: Tensor | None
    median_depth: Tensor | None
    normal: Tensor | None
    distortion: Tensor | None
    boundary: Tensor | None
    visible: Tensor
    num_nonfinite: int


class Rasterizer(ABC):
    """One backend: all its methods render Gaussians with the same weights w_i (E4).

    A backend implements the five abstract methods. ``rasterizers.optional`` has products that only refiners of other
    packages need. An instance holds no scene and may live as long as the program.
    """

    @classmethod
    @abstractmethod
    def unavailable(cls) -> str | None:
        """Return None if this backend can run here, else one sentence: why not, and what to install."""

    @abstractmethod
    def rasterize(
        self,
        inputs: SurfelInputs,
        camera: Camera,
        settings: RasterSettings,
        background: Tensor,  # [3]
        target: Tensor | None = None,  # [H, W] int32 class ids M', or IGNORE
    ) -> RasterOutputs:
        """Render the Gaussians over a background.

        Differentiable in all floats of ``inputs`` and in ``background``. With ``target``, the outputs have ``boundary``
        (E7). Raises ``ValueError`` for a wrong shape or dtype.
        """

    @abstractmethod
    def class_contributions(
        self,
        inputs: SurfelInputs,
        camera: Camera,
        settings: RasterSettings,
        labels: Tensor,  # [H, W] int32 class ids, or IGNORE
        num_classes: int,
    ) -> Tensor:
        """Return C[i, c] of this view: the sum of w_i(u) over the pixels u with labels(u) = c (E6).

        Returns [N, num_classes] of the inputs' dtype, without gradient.
        """

    def sparse_class_contributions(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, labels: Tensor, num_classes: int
    ) -> tuple[Tensor, Tensor]:
        """Return the non-zero entries of ``class_contributions``: keys [M] int64 and values [M].

        The keys are i * num_classes + c, ascending. This method makes a dense table of the classes in ``labels``; a
        backend that needs no table should override it.
        """
        return sparse_table(
            lambda slots, count: self.class_contributions(inputs, camera, settings, slots, count), labels, num_classes
        )

    @abstractmethod
    def class_map(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, num_classes: int
    ) -> tuple[Tensor, Tensor]:
        """Return the class of every pixel, argmax_c sum_i w_i [phi_i = c], and its share (method, section 5).

        Returns [H, W] int32, with ties to the lower id; and [H, W] float, the class's share of A. Both are 0 where
        A = 0. Neither has a gradient.
        """

    def feature_channels(
        self, inputs: SurfelInputs, features: Tensor, camera: Camera, settings: RasterSettings
    ) -> Tensor | None:
        """Render features as ``rendering.draw_features`` does, but in one pass.

        Returns None where rendering three channels at a time costs less. Every Gaussian with a feature that is not
        finite must have a colour that is not finite too.
        """
        return None

    @abstractmethod
    def dominant_gaussian(self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings) -> Tensor:
        """Return [H, W] int32, the index of the Gaussian with the largest w_i (ties to the nearer), or -1."""


def sparse_table(table: Callable[[Tensor, int], Tensor], labels: Tensor, num_classes: int) -> tuple[Tensor, Tensor]:
    """Return the non-zero entries of a table of Gaussians and classes: keys [M] int64 and values [M].

    The keys are i * num_classes + c. table: returns [N, count] for renumbered labels [H, W] int32 (or IGNORE) and the
    number of classes that ``labels`` hold.
    """
    present = torch.unique(labels[(labels >= 0) & (labels < num_classes)])
    columns = torch.searchsorted(present, labels)
    known = torch.isin(labels, present)
    dense = table(torch.where(known, columns, IGNORE).int(), len(present))
    surfel, column = torch.nonzero(dense, as_tuple=True)
    return surfel * num_classes + present[column].long(), dense[surfel, column]
