"""OpenGaussian: features of Gaussians that are trained to agree within masks, and codebooks of them.

Wu et al., "OpenGaussian: Towards Point-Level 3D Gaussian-based Open Vocabulary Understanding", NeurIPS 2024. A feature
f_i [6] is rendered as phi(f) = (f / |f| + 1) / 2, F(u) = sum_i w_i phi(f_i), with A(u) = sum_i w_i. In a view with
masks P_1 .. P_n, including the background's, and the means mu_m of F over the pixels of P_m where A > 0.7,

    cohesion    = mean over m of the mean over P_m of |F(u) - mu_m|,
    separation  = sum over a != b of w_ab / (1 + |mu_a - mu_b|^2) / (n (n - 1)),   w_ab = 0.1 + 0.9 rank / (n - 1),

where rank is the place of b among the others of a, the nearest last. Codebooks are k-means of f and positions, then of
f within a cluster. If a Gaussian is rendered with the feature q of its centre, f gets the gradient by q.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import embedding, pad

from beags_baselines.grouped_sums import grouped_sums
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.losses.reduction import ordered_sum

CHANNELS = 6
SOLID = 0.7  # alpha above which a pixel shows something
LEAST_WEIGHT = 0.1  # least weight of a pair of masks
LLOYD_STEPS = 5
MAX_VARIANCE = 0.006  # largest variance of rendered features within a mask that is kept
LARGE_AREA = 0.8  # share of the view's largest mask above which a mask is kept with any variance
MATCH_SCORE = 0.2  # score that a mask must exceed to give a leaf its class


def drawn_form(features: Tensor) -> Tensor:
    """Return phi(f) [N, 6] in 0..1; phi(0) is 1/2."""
    return (features / _length(features) + 1.0) / 2.0


def _length(rows: Tensor) -> Tensor:
    """Return the norms [.., 1] of rows, with a gradient of 0 at 0."""
    return rows.square().sum(dim=-1, keepdim=True).clamp_min(1e-24).sqrt()


@dataclass(frozen=True)
class MaskedPixels:
    """The n masks of one view of P pixels, one for each class in it.

    classes: [n] int64, ranks, ascending. places: [P] int64, the index of each pixel's mask, or n without a mask.
    areas: [n] int64.
    """

    classes: Tensor
    places: Tensor
    areas: Tensor

    @classmethod
    def of(cls, ranks: Tensor) -> MaskedPixels:
        """Return the masks of a map [H, W] int of ranks or IGNORE, which is no mask."""
        flat = ranks.reshape(-1).long()
        flat = flat.masked_fill(flat == IGNORE, -1) + 1
        counts = torch.bincount(flat, minlength=1)[1:]
        classes = counts.nonzero()[:, 0]
        place = counts.new_full((len(counts) + 1,), len(classes))
        place[classes + 1] = torch.arange(len(classes), device=flat.device)
        return cls(classes, place[flat], counts[classes])

    def __len__(self) -> int:
        return len(self.classes)

    @property
    def labelled(self) -> Tensor:
        """Return [P] bool: the pixels with a mask."""
        return self.places < len(self)

    def sums(self, rows: Tensor) -> Tensor:
        """Return the sums of values [P, C] over each mask, [n, C]; differentiable."""
        return grouped_sums(rows, self.places, len(self) + 1)[:-1]

    def spread(self, values: Tensor) -> Tensor:
        """Return for each pixel the value [n, C] of its mask, [P, C], 0 without a mask; differentiable."""
        return embedding(self.places, pad(values, (0, 0, 0, 1)))

    def means(self, rows: Tensor, chosen: Tensor | None = None) -> Tensor:
        """Return the means of values [P, C] over the ``chosen`` [P] bool pixels of each mask, [n, C]; 0 without any."""
        if chosen is None:
            return self.sums(rows) / self.areas[:, None]
        weights = chosen.to(rows.dtype)[:, None]
        return self.sums(rows * weights) / self.sums(weights).clamp_min(1.0)


def cohesion(rendered: Tensor, means: Tensor, masks: MaskedPixels) -> Tensor:
    """Return the mean over masks of the mean distance of their pixels [P, 6] from the mask's mean [n, 6]."""
    distances = _length(rendered - masks.spread(means))[:, 0]
    shares = pad(1.0 / masks.areas.to(rendered.dtype), (0, 1))[masks.places]
    return ordered_sum(distances * shares) / max(len(masks), 1)


def separation(means: Tensor, late: bool = False) -> Tensor:
    """Return how near the means [n, C] of different masks are; 0 for a single mask.

    late: in the second half of the training weights below 0.9 become 0.1.
    """
    count = len(means)
    if count < 2:
        return ordered_sum(means) * 0.0
    inverse = 1.0 / (1.0 + (means[:, None] - means).square().sum(dim=-1))
    ranked = inverse.detach().clone().fill_diagonal_(0.0)
    ranks = ranked.argsort(dim=1, stable=True).argsort(dim=1)
    weights = LEAST_WEIGHT + (1.0 - LEAST_WEIGHT) * ranks / (count - 1)
    if late:
        weights = torch.where(weights < 0.9, LEAST_WEIGHT, weights)
    return ordered_sum(weights.fill_diagonal_(0.0) * inverse) / (count * (count - 1))


@dataclass(frozen=True)
class PseudoMasks:
    """The M masks of all views as pseudo labels.

    views, classes: [M] int64, classes as ranks. means: [M, 6], mean rendered features. kept: [M] bool, whether the
    features agree within the mask, or the mask is large.
    """

    views: Tensor
    classes: Tensor
    means: Tensor
    kept: Tensor

    @classmethod
    def none(cls, like: Tensor) -> PseudoMasks:
        """Return an empty set; like: features."""
        nothing = torch.zeros(0, dtype=torch.int64, device=like.device)
        return cls(nothing, nothing, like.new_zeros(0, CHANNELS), nothing.bool())

    @classmethod
    def of_view(cls, view: int, rendered: Tensor, masks: MaskedPixels) -> PseudoMasks:
        """Return the masks of one view; rendered: [P, 6], F."""
        means = masks.means(rendered)
        variance = masks.means((rendered - masks.spread(means)).square()).mean(dim=1)
        large = masks.areas > LARGE_AREA * masks.areas.max() if len(masks) else masks.areas > 0
        return cls(torch.full_like(masks.classes, view), masks.classes, means, (variance <= MAX_VARIANCE) | large)

    @classmethod
    def joined(cls, parts: list[PseudoMasks]) -> PseudoMasks:
        """Return all parts as one."""
        return cls(*(torch.cat(values) for values in zip(*(vars(part).values() for part in parts), strict=True)))

    def of(self, view: int) -> PseudoMasks:
        """Return the masks of one view, in the order of ``MaskedPixels``."""
        own = self.views == view
        return PseudoMasks(*(values[own] for values in vars(self).values()))


def label_loss(
    rendered: Tensor,
    alpha: Tensor,
    masks: MaskedPixels,
    labels: PseudoMasks,
    squared: bool = False,
    exclude_dropped: bool = False,
) -> Tensor:
    """Return the mean of |F - G|_1 over labelled solid pixels; G is the mean of the pixel's mask, or 0 if not kept.

    rendered: [P, 6]. alpha: [P]. squared: |F - G|^2 instead. exclude_dropped: pixels of masks that are not kept do not
    count.
    """
    difference = rendered - masks.spread(labels.means * labels.kept[:, None])
    distances = (difference.square() if squared else difference.abs()).sum(dim=1)
    counted = (alpha > SOLID) & masks.labelled
    if exclude_dropped:
        counted &= pad(labels.kept, (0, 1))[masks.places]
    return ordered_sum(distances * counted) / counted.sum().clamp_min(1)


@dataclass
class Codebook:
    """Clusters and leaves; leaf j * fine + l is the l-th of cluster j.

    coarse: [k1, 9] centres. clusters: [N] int64. fine: [k1, k2, 6] centres. leaves: [N] int64, k1 * k2 until a
    Gaussian's cluster is divided. used: [k1] int64, number of leaves. occurs: [V, k1] bool, views that show a cluster.
    """

    coarse: Tensor
    clusters: Tensor
    fine: Tensor
    leaves: Tensor
    used: Tensor
    occurs: Tensor


def straight_through(features: Tensor, centres: Tensor) -> Tensor:
    """Return centres [N, 6], whose gradient goes unchanged to features [N, 6]."""
    return centres.detach() + (features - features.detach())


def _finite(vectors: Tensor) -> Tensor:
    """Return vectors with 0 in place of NaN and infinite numbers, which broken Gaussians have."""
    return torch.nan_to_num(vectors, nan=0.0, posinf=0.0, neginf=0.0)


def nearest_centres(vectors: Tensor, centres: Tensor) -> Tensor:
    """Return the index of the centre [k, D] nearest to each vector [N, D], [N] int64."""
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (compiled, without stubs)

    cloud = _finite(vectors.detach().cpu().double()).numpy()
    tree = cKDTree(centres.cpu().double().numpy())
    return torch.from_numpy(tree.query(cloud, workers=torch.get_num_threads())[1]).long().to(vectors.device)


def lloyd(vectors: Tensor, centres: Tensor, steps: int = LLOYD_STEPS) -> tuple[Tensor, Tensor]:
    """Return centres [k, D] after steps of k-means from ``centres``, and the nearest to each vector, [N] int64.

    A centre without vectors becomes 0, as in the source. scikit-learn's k-means would move it, and its sums depend on
    the number of threads.
    """
    vectors = _finite(vectors)
    for _ in range(steps):
        ids = nearest_centres(vectors, centres)
        counts = torch.bincount(ids, minlength=len(centres)).clamp_min(1)
        centres = grouped_sums(vectors, ids, len(centres)) / counts[:, None]
    return centres, nearest_centres(vectors, centres)


def first_centres(vectors: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return [count, D]: random vectors [N, D] without replacement, and zeros if there are fewer."""
    chosen = torch.randperm(len(vectors), generator=generator)[:count].to(vectors.device)
    return pad(_finite(vectors[chosen]), (0, 0, 0, count - len(chosen)))


def fine_clusters(
    rendered: Tensor, silhouette: Tensor, masks: MaskedPixels, labels: PseudoMasks, most: int = 10
) -> int:
    """Return the number of a view's pseudo masks that a cluster, rendered alone, shows: see ``opengaussian``.

    rendered: [P, 6]. silhouette: [P] bool. A mask counts if the silhouette covers more than a fifth of it and both have
    similar means over the common pixels.
    """
    covered = masks.sums(silhouette.to(rendered.dtype)[:, None])[:, 0] / masks.areas
    difference = masks.means(rendered, silhouette) - labels.means
    alike = (difference.abs().sum(dim=1) < 0.9) & (difference.square().sum(dim=1) < 0.25)
    return min(int((labels.kept & (covered > 0.2) & alike).sum()), most)


def matched_mask(rendered: Tensor, silhouette: Tensor, masks: MaskedPixels, labels: PseudoMasks) -> int | None:
    """Return the index of the pseudo mask that best matches a leaf rendered alone, or None.

    The score is IoU x (1 - |mean F over the silhouette - mean of the mask|_1), over labelled pixels. rendered: [P, 6].
    silhouette: [P] bool.
    """
    silhouette = silhouette & masks.labelled
    area = silhouette.sum()
    if not len(masks) or area == 0:
        return None
    common = masks.sums(silhouette.to(torch.float64)[:, None])[:, 0]
    mean = grouped_sums(rendered, (~silhouette).long(), 2)[0] / area
    likeness = 1.0 - (mean - labels.means).abs().sum(dim=1).double()
    scores = (common / (area + masks.areas - common) * likeness).masked_fill(~labels.kept, 0.0)
    best = int(scores.argmax())
    return best if float(scores[best]) > MATCH_SCORE else None


def inliers(points: Tensor) -> Tensor:
    """Return [n] bool: points whose mean squared distance to the nearest K = floor(sqrt(n)) is not far above others'.

    points: [n, 3]. The bound is the mean plus the standard deviation of all these distances. A point is the nearest to
    itself.
    """
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (compiled, without stubs)

    if len(points) < 2:
        return torch.ones(len(points), dtype=torch.bool, device=points.device)
    cloud = _finite(points.detach().cpu().double()).numpy()
    ranks = list(range(1, int(len(cloud) ** 0.5) + 1))
    squares = cKDTree(cloud).query(cloud, k=ranks, workers=torch.get_num_threads())[0] ** 2
    inside = squares.mean(axis=1) <= squares.mean() + squares.std()
    return torch.from_numpy(inside).to(points.device)
