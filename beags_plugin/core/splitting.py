"""Split surfels in two with as little visible change as two surfels allow."""

from __future__ import annotations

import torch
from torch import Tensor

from beags_plugin.core.densification import Densified
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels, opacities

OFFSET = 0.5  # of both halves from the former centre, in former scales: far enough to learn different things


def split_in_two(surfels: Surfels, chosen: Tensor) -> Densified:
    """Replace each chosen surfel by two along its longer axis that together look nearly as it did.

    surfels: N surfels without gradients. chosen: [N] bool. The others keep their order; the halves follow them.
    Two discs of opacity o' cover 1 - (1 - o' g1)(1 - o' g2). The least-squares fit to o g over the disc gives halves of
    opacity o (0.58 + 0.2 o), scale times 0.85 - 0.09 o along the axis and times 1 - 0.06 o across. They differ by 1.5 %
    (o = 0.1) to 7.5 % (o = 0.99) of the disc's own root mean square.
    """
    kept, split = (~chosen).nonzero()[:, 0], chosen.nonzero()[:, 0]
    source = torch.cat([kept, split, split])
    fresh = torch.zeros(len(source), dtype=torch.bool, device=source.device)
    fresh[len(kept) :] = True
    halves = surfels[source]
    if len(split):
        log_scales, opacity = surfels.log_scales[split], opacities(surfels.opacity_logits[split])
        longer = log_scales.argmax(dim=1, keepdim=True)
        axes = rotation_from_quat(surfels.quats[split])
        along = torch.where(longer == 0, axes[..., 0], axes[..., 1])
        offset = OFFSET * log_scales.exp().gather(1, longer) * along
        shrink = (1.0 - 0.06 * opacity)[:, None].repeat(1, 2).scatter(1, longer, (0.85 - 0.09 * opacity)[:, None])
        halves.means[len(kept) :] += torch.cat([offset, -offset])
        halves.log_scales[len(kept) :] += shrink.log().repeat(2, 1)
        halves.opacity_logits[len(kept) :] = torch.logit(opacity * (0.58 + 0.2 * opacity)).repeat(2)
    return Densified(halves, source, fresh)
