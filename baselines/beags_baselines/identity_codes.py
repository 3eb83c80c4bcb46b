"""Gaussian Grouping: identity codes that are drawn like colours, a classifier of them, and objects in space.

Ye, Danelljan, Yu, Ke: "Gaussian Grouping: Segment and Edit Anything in 3D Scenes", ECCV 2024. With codes e_i [16] and
E(u) = sum_i w_i e_i, on no background and not divided by alpha:

    L_2d = mean over labelled pixels of CE(classifier(E(u)), M(u)) / ln 256
    L_3d = 2 / 256 x mean over anchors a and their 5 nearest n of sum_c q_a (ln(q_a + 1e-10) - ln(q_n + 1e-10))

with q = softmax(classifier(e)); the nearest of an anchor include itself. L_2d reaches codes, classifier and, through
the weights w, the geometry; L_3d reaches codes and classifier alone. 256 is the source's number of classes: it stays in
both normalisers, while the classifier has an output for each class that there is.
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
FULL_STEPS = 30_000  # of the source, from scratch
FASTEST = 10.0  # bound of the factor of both rates in short runs
NORMALISER = 256  # classes
INTERVAL = 5  # steps from one L_3d to the next
NEAREST = 5
WEIGHT_3D = 2.0
LARGEST_SAMPLE = 200_000
ANCHORS = 1_000
THRESHOLD = 0.3  # of an object in space
HULL = True
IQR_FACTOR = 1.0
LEAST_INLIERS = 5  # of a hull

Classify = Callable[[Tensor], Tensor]


class Classifier(nn.Linear):
    """Logits [..., K] of codes [..., 16], with the same bits and gradients for any number of threads."""

    def forward(self, input: Tensor) -> Tensor:
        bias = self.weight.new_zeros(len(self.weight)) if self.bias is None else self.bias
        return ordered_linear(input, self.weight, bias)


def initial_codes(count: int, generator: torch.Generator) -> Tensor:
    """Return e [count, 16] float32: uniform numbers, turned into coefficients as colours are."""
    return (torch.rand(count, CHANNELS, generator=generator) - 0.5) / SH_C0


def initial_classifier(num_classes: int, generator: torch.Generator, bias: bool = True) -> Classifier:
    """Return the classifier of codes as torch would start it, uniform within 1/4, but drawn from ``generator``."""
    # on "meta" it draws nothing from torch's own
    layer = Classifier(CHANNELS, num_classes, bias=bias, device="meta").to_empty(device="cpu")
    with torch.no_grad():
        for values in layer.parameters():
            values.uniform_(-(CHANNELS**-0.5), CHANNELS**-0.5, generator=generator)
    return layer


def rate_factor(steps: int) -> float:
    """Return the factor of both rates for a run of ``steps``: short ones learn faster, up to ten times."""
    return min(FULL_STEPS / steps, FASTEST)


def pixel_loss(classifier: Classify, drawn: Tensor, labels: Tensor | None) -> Tensor:
    """Return L_2d; 0 without labelled pixels. drawn: [H, W, C], E. labels: [H, W] int, or IGNORE; None without mask."""
    return label_entropy(classifier(drawn), labels) / math.log(NORMALISER)


def nearest_in_space(
    means: Tensor,
    generator: torch.Generator,
    nearest: int = NEAREST,
    anchors: int = ANCHORS,
    largest_sample: int = LARGEST_SAMPLE,
) -> Tensor:
    """Draw anchors and find the Gaussians nearest to each; an anchor is its own first one but where centres coincide.

    The search tree costs most: where centres move little, ask for the anchors of many steps and use them in turn.

    means: [N, 3], N at least 1. generator: on the CPU. Returns [A, 1 + nearest] int64: an anchor, then its nearest.
    """
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (compiled, without stubs)

    count = len(means)
    sample = torch.arange(count)
    if count > largest_sample:
        sample = torch.randperm(count, generator=generator)[:largest_sample]
    chosen = torch.randperm(len(sample), generator=generator)[:anchors]
    cloud = torch.nan_to_num(means.detach().cpu()[sample].double(), nan=0.0, posinf=0.0, neginf=0.0).numpy()
    wanted = list(range(1, min(nearest, len(sample)) + 1))  # a list keeps the axis even of a single one
    places = torch.from_numpy(cKDTree(cloud).query(cloud[chosen.numpy()], k=wanted)[1]).long()
    return sample[torch.cat([chosen[:, None], places], dim=1)].to(means.device)


def probabilities(classifier: Classify, codes: Tensor) -> Tensor:
    """Return [..., K], the softmax of the logits of codes [..., C]; its gradient is that of any number of threads."""
    return classifier(codes).log_softmax(dim=-1).exp()  # the gradient of torch's softmax is not


def neighbour_loss(classifier: Classify, codes: Tensor, groups: Tensor, weight: float = WEIGHT_3D) -> Tensor:
    """Return L_3d. codes: [N, C]. groups: [A, 1 + k] int64 of ``nearest_in_space``."""
    # Determinism: the gradient of codes[groups] depends on the number of threads.
    q = probabilities(classifier, embedding(groups, codes))
    logs = (q + 1e-10).log()
    divergence = (q[:, :1] * (logs[:, :1] - logs[:, 1:])).sum(dim=-1)
    return weight / NORMALISER * ordered_mean(divergence)


def right_pixels(logits: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Return how many labelled pixels have their class as the largest logit, and how many are labelled."""
    return (logits.argmax(dim=-1) == labels).sum(), (labels < logits.shape[-1]).sum()


def members(
    probabilities: Tensor, class_id: int, means: Tensor, threshold: float = THRESHOLD, hull: bool = HULL
) -> Tensor:
    """Return [N] bool, an object: up to three may have the same Gaussian at the default threshold, or none.

    probabilities: [N, K], softmax(classifier(e)). hull: with all whose centre lies inside the hull of those above the
    threshold, but for outliers among them.
    """
    chosen = probabilities[:, class_id] > threshold
    return chosen | inside_hull(means, chosen) if hull else chosen


def inside_hull(means: Tensor, chosen: Tensor, least: int = LEAST_INLIERS, else_all: bool = False) -> Tensor:
    """Return [N] bool: the centre lies inside the convex hull of the chosen ones that are no outliers.

    An outlier lies, along any axis, more than an interquartile range beyond the quartiles. All False where fewer than
    ``least`` in general position are left; with ``else_all`` outliers stay where fewer than that would be left.
    Centres that are not finite never take part.
    means: [N, 3]. chosen: [N] bool.
    """
    import numpy as np
    from scipy.spatial import Delaunay, QhullError

    nobody = torch.zeros_like(chosen)
    centers = means.detach().double().cpu().numpy()
    cloud = centers[chosen.cpu().numpy() & np.isfinite(centers).all(axis=1)]
    if len(cloud) < least:
        return nobody
    low, high = np.quantile(cloud, [0.25, 0.75], axis=0)
    reach = IQR_FACTOR * (high - low)
    inliers = cloud[((cloud >= low - reach) & (cloud <= high + reach)).all(axis=1)]
    if len(inliers) < least and not else_all:
        return nobody
    try:
        hull = Delaunay(inliers if len(inliers) >= least else cloud)
        return torch.from_numpy(hull.find_simplex(centers) >= 0).to(chosen.device)
    except QhullError:  # all in a plane
        return nobody
