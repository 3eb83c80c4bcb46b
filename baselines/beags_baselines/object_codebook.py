"""Unified-Lift: codes that are contrasted by object, and a codebook of object vectors that classifies them.

Zhu et al., "Rethinking End-to-End 2D to 3D Scene Segmentation in Gaussian Splatting" (Unified-Lift), CVPR 2025. With F
[P, 16] the rendered codes of a view's labelled pixels, x = F / (|F| + 1e-6), whose norm has no gradient, u_a the mean
of x over the n_a pixels of id a, and S_a the sum of their distances |x - u_a|:

    L_con = mean over ids a of  sum over x of a of  -ln(e^{x.u_a / f_a} / (sum_b e^{x.u_b / f_b} + 1e-6)),
    f_a = clip(10 S_a / (n_a ln(n_a + 10)), 0.5, 1),
    L_reg = mean over all pixels of (|F| - 1)^2.

Both have gradients to the codes only. For the codebook B [256, 16] F has no gradient. A Hungarian matching gives each
id a of the view a code pi(a) by the sum of softmax(B F) over its pixels, so that large masks choose first. The reliable
pixels R are those whose own id has a share above 0.2 in the sum of e^{x.u_b / f_b}, f_b = clip(0.1 S_b / .., 0.1, 1):

    L_cls = mean over R of CE(B F, pi(M)) / ln 256,  if any pixel of the view gets another code than it should,
    L_conc = mean over R of |x - B_pi(M)|.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy, embedding
from torch.utils.checkpoint import checkpoint

from beags_baselines.grouped_sums import grouped_sums
from beags_baselines.identity_codes import NORMALISER, THRESHOLD, Classify, probabilities
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.losses.reduction import ordered_linear, ordered_mean, ordered_outer_sum, ordered_sum

SAMPLES = 32_768  # random pixels of L_con, with replacement
LEAST_PIXELS = 20  # samples that an id must exceed
WEIGHTS = {"contrast": 1e-6, "norms": 1e-6, "classes": 1e-4, "concentration": 1.0}
RELIABLE = 0.2  # share of the own id above which a pixel is reliable
OWNED = 0.7  # share of a code's pixels above which it belongs to a class
RULES = ("softmax", "argmax")
"""Rules by which a Gaussian belongs to an object: softmax(B f) is above the threshold for one of the object's codes
(default), or its largest code is the object's."""
CODES = 256

AT_ONCE = 2**22  # logits, or other values of pixels, in memory at a time: 16 MB


def sampled(count: int, generator: torch.Generator) -> Tensor:
    """Return ``SAMPLES`` random indices below ``count``, with replacement, [S] int64, on the CPU."""
    return torch.randint(count, (SAMPLES,), generator=generator)


def directions(rendered: Tensor) -> Tensor:
    """Return x [P, C] of F [P, C]; the norm has no gradient."""
    return rendered / (rendered.detach().norm(dim=1, keepdim=True) + 1e-6)


def contrast(rendered: Tensor, ids: Tensor) -> Tensor:
    """Return L_con of sampled pixels; 0, with a gradient of 0, if no id has enough of them.

    rendered: [S, C], F. ids: [S] int64, of any values.
    """
    x = directions(rendered)
    _, group, counts = torch.unique(ids, return_inverse=True, return_counts=True)
    enough = counts > LEAST_PIXELS
    if (many := int(enough.sum())) == 0:
        return 0.0 * ordered_sum(rendered)
    group = torch.where(enough, enough.cumsum(0) - 1, many)[group]  # the other ids form a last group, which is dropped
    means, temperatures = _prototypes(x, group, many + 1, 10.0, 0.5)
    means, temperatures = means[:many], temperatures[:many]
    scores = ordered_linear(x, means / temperatures[:, None], x.new_zeros(many))
    own = scores.gather(1, group.clamp(max=many - 1)[:, None])[:, 0]
    each = (scores.exp().sum(dim=1) + 1e-6).log() - own
    return ordered_sum(torch.where(group < many, each, 0.0)) / many


def norms(rendered: Tensor, labelled: Tensor) -> Tensor:
    """Return L_reg over the labelled pixels, at least one. rendered: [P, C]. labelled: [P] bool."""
    return ordered_sum(torch.where(labelled, (rendered.norm(dim=1) - 1.0) ** 2, 0.0)) / labelled.sum()


@torch.no_grad()
def reliable(rendered: Tensor, group: Tensor, count: int) -> Tensor:
    """Return R, [P] bool. rendered: [P, C], F. group: [P] int64 below ``count``, the numbered ids of the view."""
    return own_shares(rendered, group, count) > RELIABLE


def own_shares(rendered: Tensor, group: Tensor, count: int) -> Tensor:
    """Return p [P], the share of each pixel's own id among the prototypes; see ``reliable``."""
    x = directions(rendered)
    means, temperatures = _prototypes(x, group, count, 0.1, 0.1)
    weight, nothing = means / temperatures[:, None], x.new_zeros(count)
    shares = torch.empty_like(x[:, 0])
    for rows in _chunks(len(x), count):
        similar = ordered_linear(x[rows], weight, nothing).exp()
        shares[rows] = similar.gather(1, group[rows, None])[:, 0] / similar.sum(dim=1)
    return shares


def _prototypes(x: Tensor, group: Tensor, count: int, factor: float, least: float) -> tuple[Tensor, Tensor]:
    """Return u [count, C], with gradient, and f [count], without."""
    numbers = torch.bincount(group, minlength=count).clamp(min=1)
    means = (grouped_sums(x.double(), group, count) / numbers[:, None]).to(x)
    with torch.no_grad():
        distances = (x - means[group]).norm(dim=1, keepdim=True)
        spread = grouped_sums(distances.double(), group, count)[:, 0] / (numbers * (numbers + 10.0).log())
        temperatures = (factor * spread).clamp(least, 1.0).to(x)
    return means, temperatures


@torch.no_grad()
def code_masses(classify: Classify, rendered: Tensor, group: Tensor, count: int, codes: int) -> tuple[Tensor, Tensor]:
    """Return the sums of softmax(B F) over each id's pixels, [count, codes], and the largest code of each pixel, [P].

    rendered: [P, C], F. group: [P] int64 below ``count``.
    """
    masses, largest = rendered.new_zeros(count, codes), torch.empty_like(group)
    for rows in _chunks(len(rendered), codes + count):
        logits = classify(rendered[rows])
        largest[rows] = logits.argmax(dim=1)
        one_hot = torch.nn.functional.one_hot(group[rows], count).to(rendered)
        masses += ordered_outer_sum(one_hot, logits.softmax(dim=1))
    return masses, largest


def largest_codes(classify: Classify, rows: Tensor, codes: int) -> Tensor:
    """Return the code of largest logit for each row [P, C], [P] int64; codes: their number."""
    return torch.cat([classify(rows[part]).argmax(dim=1) for part in _chunks(len(rows), codes)])


def matching(masses: Tensor) -> Tensor:
    """Return pi [n] int64, a different code for each id: the matching of largest mass. masses: [n, codes]."""
    from scipy.optimize import linear_sum_assignment

    return torch.from_numpy(linear_sum_assignment(masses.double().cpu().numpy(), maximize=True)[1]).to(masses.device)


def code_entropy(classify: Classify, rendered: Tensor, labels: Tensor, outputs: int) -> Tensor:
    """Return the cross-entropy of each pixel, [P]; memory holds the logits of some pixels at a time, see ``AT_ONCE``.

    rendered: [P, C]; it and the classifier get gradients. labels: [P] int below ``outputs``, or IGNORE, where the
    result is 0.
    """

    def part(rows: slice) -> Tensor:
        return cross_entropy(classify(rendered[rows]), labels[rows].long(), ignore_index=IGNORE, reduction="none")

    parts = _chunks(len(rendered), outputs)
    if len(parts) == 1:
        return part(parts[0])
    return torch.cat([checkpoint(part, rows, use_reentrant=False, preserve_rng_state=False) for rows in parts])


def selection(classify: Classify, rendered: Tensor, targets: Tensor, outputs: int) -> Tensor:
    """Return L_cls of the pixels of R, at least one. rendered: [R, C], F. targets: [R] int64, pi(M)."""
    return ordered_mean(code_entropy(classify, rendered, targets, outputs)) / math.log(NORMALISER)


def concentration(codebook: Tensor, rendered: Tensor, targets: Tensor) -> Tensor:
    """Return L_conc of the pixels of R; 0 without any. rendered: [R, C], F without gradient. targets: [R], pi(M)."""
    return ordered_mean((directions(rendered) - embedding(targets, codebook)).norm(dim=1))


def owners(tables: Tensor) -> Tensor:
    """Return the class of each code, [codes] int64, -1 for none.

    tables: [K, codes] int64, labelled pixels of each class that get a code, over all views. A code belongs to a class
    that has more than ``OWNED`` of its pixels.
    """
    most, owner = tables.max(dim=0)
    return torch.where(most.double() > OWNED * tables.sum(dim=0).double(), owner, -1)


@torch.no_grad()
def members_by_softmax(
    classify: Classify, codes: Tensor, owner: Tensor, num_classes: int, threshold: float = THRESHOLD
) -> dict[int, Tensor]:
    """Return rank to [N] bool for the objects: softmax(B f) is above the threshold for a code of the object.

    codes: [N, C], f. owner: [codes] int64 ranks, or -1. Rank 0 is the background, which is no object.
    """
    objects = {rank: torch.zeros(len(codes), dtype=torch.bool, device=codes.device) for rank in range(1, num_classes)}
    for rows in _chunks(len(codes), len(owner)):
        at, code = (probabilities(classify, codes[rows]) > threshold).nonzero().unbind(dim=1)
        of = owner[code]
        for rank in torch.unique(of[of > 0]).tolist():
            objects[rank][rows.start + at[of == rank]] = True
    return objects


@torch.no_grad()
def ranks_by_argmax(classify: Classify, codes: Tensor, owner: Tensor) -> Tensor:
    """Return [N] int64: the rank of the class of each Gaussian's largest code, 0 if it belongs to none."""
    return owner[largest_codes(classify, codes, len(owner))].clamp(min=0)


def _chunks(rows: int, width: int) -> list[slice]:
    """Return slices of rows of ``width`` numbers, each slice with about ``AT_ONCE`` numbers; at least one slice."""
    size = max(AT_ONCE // max(width, 1), 1)
    return [slice(first, min(first + size, rows)) for first in range(0, max(rows, 1), size)]
