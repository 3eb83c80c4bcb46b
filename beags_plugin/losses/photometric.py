"""The image loss of the base training: (1 - w) L1 + w (1 - SSIM), w = 0.2 (method, section 1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from beags_plugin.losses.base import Loss, LossInputs
from beags_plugin.losses.reduction import ordered_mean
from beags_plugin.ops import cuda_extension
from beags_plugin.ops import photometric as compiled
from beags_plugin.system.errors import UserError

WINDOW = 11
SIGMA = 1.5
_REACH = WINDOW // 2
_C1, _C2 = 0.01**2, 0.03**2  # SSIM's constants for values in 0..1, which keep flat regions from dividing by 0.
_BLOCK = 32  # Pixels filtered by one small matrix product; 32 was faster than 16 and 64.


@dataclass(frozen=True)
class PhotometricLoss(Loss):
    """(1 - ssim_weight) L1 + ssim_weight (1 - SSIM) between the rendered image and the photograph."""

    ssim_weight: float = 0.2

    def __post_init__(self) -> None:
        if not 0.0 <= self.ssim_weight <= 1.0:
            raise UserError(f"the photometric loss has ssim_weight = {self.ssim_weight}: it must lie in 0..1.")

    def value(self, inputs: LossInputs) -> Tensor:
        rendered, photo = inputs.render.color, inputs.image.to(inputs.render.color)
        if _compiled_takes(rendered, photo):
            weight = self.ssim_weight
            return compiled.photometric(rendered, photo, 1.0 - weight, -weight, _C1, _C2, offset=weight)
        absolute = ordered_mean((rendered - photo).abs())
        if self.ssim_weight == 0.0:
            return absolute
        return (1.0 - self.ssim_weight) * absolute + self.ssim_weight * (1.0 - ssim(rendered, photo))


def ssim(image: Tensor, reference: Tensor) -> Tensor:
    """Return the mean structural similarity: Gaussian window of 11 pixels, sigma 1.5, zeros outside as in 3DGS.

    image, reference: [H, W, C] float of one dtype, in 0..1. Returns a scalar in -1..1, with a gradient for ``image``.
    Raises ``ValueError`` if the shapes differ or ``reference`` wants a gradient.
    """
    if image.ndim != 3 or image.shape != reference.shape:
        raise ValueError(f"two images [H, W, C] are needed, not {list(image.shape)} and {list(reference.shape)}")
    if reference.requires_grad:
        raise ValueError("the reference gets no gradient: detach it, or swap the two images")
    if _compiled_takes(image, reference):
        return compiled.photometric(image, reference, 0.0, 1.0, _C1, _C2)
    return _Ssim.apply(image, reference)


def ssim_map(image: Tensor, reference: Tensor) -> Tensor:
    """Return the map [H, W] whose mean is ``ssim``, averaged over channels; arguments as there, no gradient."""
    return _similarity(image.detach().permute(2, 0, 1), reference.permute(2, 0, 1))[0].mean(dim=0)


def _similarity(x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
    """Return the SSIM of images [C, H, W], per channel and pixel, and the parts that its gradient needs."""
    # Only the sum of the two variances is needed, so four blurs are enough instead of the usual five.
    m_x, m_y, squares, product = blur(torch.cat([x, y, x * x + y * y, x * y])).chunk(4)
    m_xx_yy, m_xy = m_x * m_x + m_y * m_y, m_x * m_y
    a1, a2 = 2 * m_xy + _C1, 2 * (product - m_xy) + _C2
    b1, b2 = m_xx_yy + _C1, squares - m_xx_yy + _C2
    inverse = 1.0 / (b1 * b2)
    return a1 * a2 * inverse, m_x, m_y, a1, a2, b1, b2, inverse


def _compiled_takes(image: Tensor, reference: Tensor) -> bool:
    same = image.ndim == 3 and image.shape == reference.shape and image.shape[2] == 3 and image.numel() > 0
    return same and not reference.requires_grad and cuda_extension.supports(image, reference)


class _Ssim(torch.autograd.Function):
    """SSIM with its gradient in closed form: three blurs replace the tensors that autograd would store."""

    @staticmethod
    def forward(ctx, image: Tensor, reference: Tensor) -> Tensor:
        x = image.permute(2, 0, 1).contiguous()
        y = reference.permute(2, 0, 1).contiguous()
        index, m_x, m_y, a1, a2, b1, b2, inverse = _similarity(x, y)
        if ctx.needs_input_grad[0]:
            d_product = 2 * a1 * inverse
            d_squares = -index / b2
            d_mean = 2 * (m_y * (a2 - a1) + m_x * index * (b1 - b2)) * inverse
            # A symmetric window with zeros outside is its own adjoint.
            g_mean, g_squares, g_product = blur(torch.cat([d_mean, d_squares, d_product])).chunk(3)
            gradient = (g_mean + 2 * x * g_squares + y * g_product) / image.numel()
            ctx.save_for_backward(gradient.permute(1, 2, 0))
        return ordered_mean(index)

    @staticmethod
    def backward(ctx, *grad_outputs: Tensor):
        (gradient,) = ctx.saved_tensors
        return grad_outputs[0] * gradient, None


def blur(maps: Tensor) -> Tensor:
    """Filter with the SSIM window, zeros outside; [M, H, W] float.

    Blocks of 32 rows or columns are multiplied by a banded 42 x 32 matrix: on a CPU 3 times faster than a convolution.
    """
    count, height, width = maps.shape
    band = _band(maps.dtype, maps.device)
    span = _BLOCK + 2 * _REACH

    # Columns: the maps lie below each other, with at least one block of zeros between them.
    padded_height = (-(-height // _BLOCK) + 1) * _BLOCK
    column = maps.new_zeros(count * padded_height + 2 * _REACH, width)
    column[: count * padded_height].view(count, padded_height, width)[:, _REACH : _REACH + height] = maps
    blocks = count * padded_height // _BLOCK
    windows = column.as_strided((blocks, span, width), (_BLOCK * width, width, 1))
    down = torch.bmm(band.T.expand(blocks, _BLOCK, span), windows).view(count, padded_height, width)[:, :height]

    # Rows: all rows lie behind each other, likewise.
    padded_width = (-(-width // _BLOCK) + 1) * _BLOCK
    rows = count * height * padded_width
    row = maps.new_zeros(rows + 2 * _REACH)
    row[:rows].view(count, height, padded_width)[:, :, _REACH : _REACH + width] = down
    across = row.as_strided((rows // _BLOCK, span), (_BLOCK, 1)) @ band
    return across.view(count, height, padded_width)[:, :, :width]


@lru_cache(maxsize=8)
def _band(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return [42, 32]: column o holds the normalised window from row o on."""
    offsets = torch.arange(WINDOW, dtype=torch.float64) - _REACH
    window = torch.exp(-0.5 * (offsets / SIGMA) ** 2)
    window /= window.sum()
    band = torch.zeros(_BLOCK + 2 * _REACH, _BLOCK, dtype=torch.float64)
    for output in range(_BLOCK):
        band[output : output + WINDOW, output] = window
    return band.to(device, dtype)


def psnr(image: Tensor, other: Tensor) -> Tensor:
    """Return the peak signal-to-noise ratio of two images with values in 0..1, [] in dB; at most 100."""
    return -10.0 * torch.log10((image - other).square().mean().clamp_min(1e-10))
