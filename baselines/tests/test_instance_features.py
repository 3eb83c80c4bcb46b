"""OpenGaussian's losses, codebooks and matches, by hand."""

from __future__ import annotations

from collections import Counter

import pytest
import torch

from beags_baselines import instance_features as parts
from beags_baselines import leaf_labels
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE


def masks_of(*ranks: int) -> parts.MaskedPixels:
    return parts.MaskedPixels.of(torch.tensor([ranks], dtype=torch.int32))


def column(*values: float) -> torch.Tensor:
    """Features [n, 6] of which only the first channel is not 0."""
    return torch.nn.functional.pad(torch.tensor(values)[:, None], (0, 5))


def test_masks_are_the_classes_that_the_view_shows():
    masks = masks_of(5, IGNORE, 2, 5, 5)
    assert masks.classes.tolist() == [2, 5] and masks.areas.tolist() == [1, 3]
    assert masks.places.tolist() == [1, 2, 0, 1, 1] and masks.labelled.tolist() == [True, False, True, True, True]
    rows = torch.tensor([[1.0], [100.0], [7.0], [2.0], [6.0]])
    assert masks.means(rows).tolist() == [[7.0], [3.0]]
    assert masks.means(rows, rows[:, 0] > 5).tolist() == [[7.0], [6.0]] and masks.spread(rows[:2])[1] == 0
    assert masks.means(rows, rows[:, 0] < 5).tolist() == [[0.0], [1.5]], "0 of no pixel"
    nothing = masks_of(IGNORE)
    assert len(nothing) == 0 and not nothing.labelled.any()


def test_separation_weighs_near_pairs_most():
    assert float(parts.separation(column(0, 1, 3))) == pytest.approx(0.236667, abs=1e-6)
    assert float(parts.separation(column(0, 1, 3), late=True)) == pytest.approx(0.206667, abs=1e-6)
    assert float(parts.separation(column(0, 2**0.5))) == pytest.approx(1 / 3)
    alone = column(0.3).requires_grad_()
    parts.separation(alone).backward()
    assert alone.grad is not None and not alone.grad.any()


def test_cohesion_takes_all_labelled_pixels_and_solid_means():
    drawn, masks = column(0.0, 1.0, 4.0, 9.0, 5.0).requires_grad_(), masks_of(0, 0, 0, IGNORE, 1)
    means = masks.means(drawn, torch.tensor([True, True, False, True, True]))
    assert means[:, 0].tolist() == [0.5, 5.0]
    loss = parts.cohesion(drawn, means, masks)
    assert loss.item() == pytest.approx((0.5 + 0.5 + 3.5) / 3 / 2)
    loss.backward()
    assert drawn.grad is not None and torch.isfinite(drawn.grad).all() and not drawn.grad[3].any()
    assert drawn.grad[:3, 0].tolist() == pytest.approx([-1 / 4, 1 / 12, 1 / 6])  # gradients pass through the mean too


def test_centres_are_drawn_and_features_get_the_gradient_as_it_is():
    features = torch.tensor([[0.6, 0.8, 0, 0, 0, 0]], requires_grad=True)
    quantised = parts.straight_through(features, torch.tensor([[1.0, 0, 0, 0, 0, 0]]))
    assert quantised.tolist() == [[1.0, 0, 0, 0, 0, 0]]
    length = quantised / quantised.norm()
    (length * torch.tensor([0.0, 1, 0, 0, 0, 0])).sum().backward()
    assert features.grad is not None and features.grad.tolist() == [[0.0, 1, 0, 0, 0, 0]]
    torch.testing.assert_close(parts.drawn_form(quantised).detach(), (length.detach() + 1) / 2)
    zero = torch.zeros(1, 6, requires_grad=True)
    parts.drawn_form(zero).sum().backward()
    assert zero.grad is not None and torch.isfinite(zero.grad).all() and bool((parts.drawn_form(zero) == 0.5).all())


def test_masks_whose_features_vary_are_dropped_unless_they_are_large():
    scattered, calm = torch.full((2, 6), 0.2), torch.zeros(2, 6)
    scattered[1], calm[:, 0] = -0.2, torch.tensor([0.1, -0.1])
    small = parts.PseudoMasks.of_view(3, torch.cat([scattered, calm, calm, calm]), masks_of(0, 0, *[1] * 6))
    assert small.kept.tolist() == [False, True] and small.views.tolist() == [3, 3]
    assert parts.PseudoMasks.of_view(0, torch.cat([scattered, calm]), masks_of(0, 0, 1, 1)).kept.all(), "large"


def test_pixels_of_dropped_masks_are_pulled_to_nothing_or_left_out():
    masks = masks_of(0, 0, 1, 1, IGNORE)
    labels = parts.PseudoMasks(torch.zeros(2).long(), masks.classes, column(0.5, 0.4), torch.tensor([True, False]))
    drawn, alpha = column(0.7, 9.0, 0.3, 0.3, 9.0), torch.tensor([1.0, 0.7, 1.0, 1.0, 1.0])  # 0.7: not solid
    assert float(parts.label_loss(drawn, alpha, masks, labels)) == pytest.approx((0.2 + 0.3 + 0.3) / 3)
    assert float(parts.label_loss(drawn, alpha, masks, labels, exclude_dropped=True)) == pytest.approx(0.2)
    squared = parts.label_loss(drawn, alpha, masks, labels, squared=True)
    assert float(squared) == pytest.approx((0.04 + 0.09 + 0.09) / 3)
    assert float(parts.label_loss(drawn, 0 * alpha, masks, labels)) == 0


def test_lloyd_moves_centres_and_empties_become_zero():
    vectors = torch.tensor([[0.0, 3.0], [0.0, 5.0], [11.0, 0.0], [float("nan"), 20.0]])
    centres, ids = parts.lloyd(vectors, torch.tensor([[1.0, 1.0], [9.0, 9.0], [90.0, 90.0]]), steps=1)
    assert centres.tolist() == [[0.0, 4.0], [5.5, 10.0], [0.0, 0.0]]  # NaN counts as 0
    assert ids.tolist() == [0, 0, 2, 1]
    broken = vectors.masked_fill(vectors.isnan(), float("inf"))
    assert torch.equal(parts.lloyd(broken, torch.tensor([[1.0, 1.0], [9.0, 9.0], [90.0, 90.0]]), steps=1)[0], centres)
    for each in (vectors, broken):
        first = parts.first_centres(each, 6, torch.Generator().manual_seed(0))
        assert sorted(first.tolist()) == sorted([*torch.nan_to_num(vectors).tolist(), [0.0, 0.0], [0.0, 0.0]])
        assert torch.isfinite(parts.lloyd(each, first)[0]).all()
    again = parts.lloyd(vectors, centres, steps=0)
    assert torch.equal(again[0], centres) and torch.equal(again[1], ids)


def test_the_best_mask_must_score():
    """Nine pixels, 1 on the first four, 2 on four, one unlabelled, and a silhouette of 0, 1, 2, 4 and that one."""
    masks, silhouette = masks_of(1, 1, 1, 1, 2, 2, 2, 2, IGNORE), torch.zeros(9, dtype=torch.bool)
    silhouette[[0, 1, 2, 4, 8]] = True
    drawn = column(0.5, 0.5, 0.5, 9, 0.5, 9, 9, 9, 9)

    def matched(first: float, second: float = 0.5, kept: bool = True) -> int | None:
        means = column(first, second)
        labels = parts.PseudoMasks(torch.zeros(2).long(), masks.classes, means, torch.tensor([kept, True]))
        return parts.matched_mask(drawn, silhouette, masks, labels)

    assert matched(0.6) == 0  # 0.54 and 0.143
    assert matched(1.3) is None  # 0.12 and 0.143
    assert matched(0.6, kept=False) is None
    nothing = parts.PseudoMasks.none(drawn)
    assert parts.matched_mask(drawn, silhouette, masks_of(*[IGNORE] * 9), nothing) is None


def test_a_cluster_has_as_many_leaves_as_masks_that_it_covers_alike():
    masks, silhouette = masks_of(*[0] * 4, *[1] * 5, *[2] * 5), torch.ones(14, dtype=torch.bool)
    silhouette[5:9] = False  # a fifth of 1 is covered, which is not more than a fifth
    labels = parts.PseudoMasks(torch.zeros(3).long(), masks.classes, column(0.1, 0.1, 0.1), torch.ones(3).bool())
    assert parts.fine_clusters(column(*[0.0] * 14), silhouette, masks, labels) == 2
    assert parts.fine_clusters(column(*[0.0] * 4, *[0.61] * 10), silhouette, masks, labels) == 1  # 0.51 off is too far.
    assert parts.fine_clusters(column(*[0.0] * 14), silhouette, masks, labels, most=1) == 1


def test_votes_name_leaves():
    votes = {0: Counter({2: 1, 1: 1}), 3: Counter({2: 1}), 7: Counter({1: 1, 2: 3})}
    assert leaf_labels.classes_of_leaves(votes) == {0: 1, 7: 2}
    assert leaf_labels.classes_of_leaves(votes, min_views=1) == {0: 1, 3: 2, 7: 2}


def test_a_query_takes_the_best_leaf_and_those_like_it():
    votes = {leaf: Counter({1: 5}) for leaf in (4, 12, 25, 31)} | {5: Counter({1: 4}), 2: Counter({1: 4, 2: 3})}
    centres = torch.zeros(40, 6)
    centres[12] = 1.0
    assert leaf_labels.queried_leaves(votes, 1, centres, 10) == [4, 2]  # 12 is unlike, 25 and 31 are too far on
    assert leaf_labels.queried_leaves(votes, 1, centres, 22) == [4, 25, 2]
    assert leaf_labels.queried_leaves(votes, 2, centres, 10) == [2, 4]  # a tie at cosine 0, as in the source
    assert leaf_labels.queried_leaves(votes, 3, centres, 10) == [] == leaf_labels.queried_leaves({}, 1, centres, 10)


def test_a_queried_object_is_small_and_together():
    points = torch.cat([torch.rand(100, 3, generator=torch.Generator().manual_seed(0)), torch.full((2, 3), 9.0)])
    logs = torch.full((102, 2), -4.0)
    logs[3, 1] = 1.0
    surfels = Surfels.of(points, torch.zeros(102, 4), logs, torch.zeros(102), torch.zeros(102, 1, 3))
    chosen = torch.ones(102, dtype=torch.bool)
    chosen[7] = False
    found = leaf_labels.queried_object(surfels, chosen, 1.0, least=100)
    assert not found[[3, 7, 100, 101]].any() and int(found.sum()) > 80
    assert not leaf_labels.queried_object(surfels, chosen, 1.0, least=101).any()
    assert not leaf_labels.queried_object(surfels, chosen, 0.1, least=1).any(), "lengths are those of the input poses"
