"""0.8 L1 + 0.2 (1 - SSIM)."""
from __future__ import annotations
from dataclasses import dataclass
import torch
from torch import Tensor
from beags_plugin.losses.base import Loss, LossInputs


def ssim(a: Tensor, b: Tensor) -> Tensor:
    x = torch.arange(11, dtype=a.dtype) - 5
    w = torch.exp(-x * x / 4.5)
    w = w / w.sum()
    def blur(i):
        c = i.shape[1]
        i = torch.nn.functional.conv2d(i, w.view(1, 1, 1, 11).expand(c, 1, 1, 11), padding=(0, 5), groups=c)
        return torch.nn.functional.conv2d(i, w.view(1, 1, 11, 1).expand(c, 1, 11, 1), padding=(5, 0), groups=c)
    a, b = a.permute(2, 0, 1)[None], b.permute(2, 0, 1)[None]
    ma, mb, aa, bb, ab = blur(torch.cat([a, b, a * a, b * b, a * b], 1)).chunk(5, 1)
    va, vb, cov = aa - ma * ma, bb - mb * mb, ab - ma * mb
    return (((2 * ma * mb + 1e-4) * (2 * cov + 9e-4)) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4))).mean()


@dataclass(frozen=True)
class PhotometricLoss(Loss):
    ssim_weight: float = 0.2

    def value(self, inputs: LossInputs) -> Tensor:
        l1 = (inputs.render.color - inputs.image).abs().mean()
        return (1 - self.ssim_weight) * l1 + self.ssim_weight * (1 - ssim(inputs.render.color, inputs.image))
