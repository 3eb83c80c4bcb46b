"""Gaussian Grouping: identity codes that are rendered like colours, a classifier of them, and objects in space.

Ye, Danelljan, Yu, Ke: "Gaussian Grouping: Segment and Edit Anything in 3D Scenes", ECCV 2024. With codes e_i [16] and
E(u) = sum_i w_i e_i, without background and not divided by alpha:

    L_2d = mean over labelled pixels of CE(classifier(E(u)), M(u)) / ln 256
    L_3d = 2 / 256 x mean over anchors a and their 5 nearest n of sum_c q_a (ln(q_a + 1e-10) - ln(q_n + 1e-10))

with q = softmax(classifier(e)); the nearest of an anchor include itself. L_2d has gradients to codes, classifier and,
through the weights w, the geometry; L_3d to codes and classifier only. 256 is the source's number of classes: it stays
in both normalisers, while the classifier has one output for each class of the scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding

from beags_baselines.object_entropy import label_entropy
from beags_plugin.core.sh import SH_C0
from beags_plugin.losses.reduction import ordered_linear, ordered_mean

CHANNELS = 16
CODE_RATE = 2.5e-3  # Adam with eps 1e-15, constant
CLASSIFIER_RATE = 5e-4  # Adam with eps 1e-8, constant
FULL_STEPS = 30_000  # steps of the source, from scratch
FASTEST = 10.0  # largest factor on both rates in short runs
NORMALISER = 256  # classes
INTERVAL = 5  # steps from one L_3d to the next
NEAREST = 5
WEIGHT_3D = 2.0
LARGEST_SAMPLE = 200_000
ANCHORS = 1_000
THRESHOLD = 0.3  # probability that a member of an object exceeds
HULL = True
IQR_FACTOR = 1.0
LEAST_INLIERS = 5  # points that a hull needs

Classify = Callable[[Tensor], Tensor]


class Classifier(nn.Linear):
    """Logits [..., K] of codes [..., 16], with the same bits and gradients for any number of threads."""

    def forward(self, input: Tensor) -> Tensor:
        bias = self.weight.new_zeros(len(self.weight)) if self.bias is None else self.bias
        return ordered_linear(input, self.weight, bias)


def initial_codes(count: int, generator: torch.Generator) -> Tensor:
    """Return e [count, 16] float32: uniform numbers, scaled to SH coefficients like colours."""
    return (torch.rand(count, CHANNELS, generator=generator) - 0.5) / SH_C0


def initial_classifier(num_classes: int, generator: torch.Generator, bias: bool = True) -> Classifier:
    """Return the classifier with torch's initial values, uniform within 1/4, from ``generator``."""
    # A layer on "meta" leaves torch's own generator untouched.
    layer = Classifier(CHANNELS, num_classes, bias=bias, device="meta").to_empty(device="cpu")
    with torch.no_grad():
        for values in layer.parameters():
            values.uniform_(-(CHANNELS**-0.5), CHANNELS**-0.5, generator=generator)
    return layer


def rate_factor(steps: int) -> float:
    """Return the factor on both rates for a run of ``steps``: up to ten in short runs."""
    return min(FULL_STEPS / steps, FASTEST)


def pixel_loss(classifier: Classify, rendered: Tensor, labels: Tensor | None) -> Tensor:
    """Return L_2d; 0 without labelled pixels. rendered: [H, W, C], E. labels: [H, W] int or IGNORE; None: no mask."""
    return label_entropy(classifier(rendered), labels) / math.log(NORMALISER)


def nearest_in_space(
    means: Tensor,
    generator: torch.Generator,
    nearest: int = NEAREST,
    anchors: int = ANCHORS,
    largest_sample: int = LARGEST_SAMPLE,
) -> Tensor:
    """Choose random anchors and return the Gaussians nearest to each.

    An anchor is the first of its own nearest, unless centres coincide. The search tree takes most of the time.

    means: [N, 3], N at least 1. generator: on the CPU. Returns [A, 1 + nearest] int64: an anchor, then its nearest.
    """
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (compiled, without stubs)

    count = len(means)
    sample = torch.arange(count)
    if count > largest_sample:
        sample = torch.randperm(count, generator=generator)[:largest_sample]
    chosen = torch.randperm(len(sample), generator=generator)[:anchors]
    cloud = torch.nan_to_num(means.detach().cpu()[sample].double(), nan=0.0, posinf=0.0, neginf=0.0).numpy()
    ranks = list(range(1, min(nearest, len(sample)) + 1))  # a list keeps the axis also for a single rank
    places = torch.from_numpy(cKDTree(cloud).query(cloud[chosen.numpy()], k=ranks)[1]).long()
    return sample[torch.cat([chosen[:, None], places], dim=1)].to(means.device)


def probabilities(classifier: Classify, codes: Tensor) -> Tensor:
    """Return the softmax of the logits of codes [..., C], [..., K]."""
    # Determinism: the gradient of torch's softmax depends on the number of threads.
    return classifier(codes).log_softmax(dim=-1).exp()


def neighbour_loss(classifier: Classify, codes: Tensor, groups: Tensor) -> Tensor:
    """Return L_3d. codes: [N, C]. groups: [A, 1 + k] int64, a result of ``nearest_in_space``."""
    # Determinism: the gradient of codes[groups] depends on the number of threads.
    q = probabilities(classifier, embedding(groups, codes))
    logs = (q + 1e-10).log()
    divergence = (q[:, :1] * (logs[:, :1] - logs[:, 1:])).sum(dim=-1)
    return WEIGHT_3D / NORMALISER * ordered_mean(divergence)


def right_pixels(logits: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Return the number of labelled pixels whose class has the largest logit, and the number of labelled pixels."""
    return (logits.argmax(dim=-1) == labels).sum(), (labels < logits.shape[-1]).sum()


def members(
    probabilities: Tensor, class_id: int, means: Tensor, threshold: float = THRESHOLD, hull: bool = HULL
) -> Tensor:
    """Return the Gaussians of an object, [N] bool; at the default threshold up to three objects may share one.

    probabilities: [N, K], softmax(classifier(e)). hull: add all Gaussians whose centres lie inside the hull of those
    above the threshold, without outliers.
    """
    chosen = probabilities[:, class_id] > threshold
    return chosen | inside_hull(means, chosen) if hull else chosen


def inside_hull(means: Tensor, chosen: Tensor, least: int = LEAST_INLIERS, else_all: bool = False) -> Tensor:
    """Return [N] bool: the centre lies inside the convex hull of the chosen Gaussians without outliers.

    An outlier lies more than an interquartile range beyond the quartiles along some axis. All values are False if fewer
    than ``least`` points in general position remain; with ``else_all`` outliers stay if fewer than ``least`` would
    remain. Centres that are not finite are left out.
    means: [N, 3]. chosen: [N] bool.
    """
    import numpy as np
    from scipy.spatial import Delaunay, QhullError

    none = torch.zeros_like(chosen)
    centers = means.detach().double().cpu().numpy()
    cloud = centers[chosen.cpu().numpy() & np.isfinite(centers).all(axis=1)]
    if len(cloud) < least:
        return none
    low, high = np.quantile(cloud, [0.25, 0.75], axis=0)
    reach = IQR_FACTOR * (high - low)
    inliers = cloud[((cloud >= low - reach) & (cloud <= high + reach)).all(axis=1)]
    if len(inliers) < least and not else_all:
        return none
    try:
        hull = Delaunay(inliers if len(inliers) >= least else cloud)
        return torch.from_numpy(hull.find_simplex(centers) >= 0).to(chosen.device)
    except QhullError:  # all points lie in a plane
        return none
