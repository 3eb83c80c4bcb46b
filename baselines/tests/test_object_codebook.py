"""Unified-Lift's losses, matching and objects, with numbers worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from beags_baselines import object_codebook as codebook
from beags_baselines.identity_codes import Classifier
from beags_plugin.labels.class_ids import IGNORE

X, Y = torch.tensor([1.0, 0.0]), torch.tensor([0.0, 1.0])


def rows(*counted: tuple[int, torch.Tensor]) -> torch.Tensor:
    return torch.cat([values.expand(count, -1) for count, values in counted])


def linear(weight: torch.Tensor) -> Classifier:
    layer = Classifier(weight.shape[1], len(weight), bias=False)
    with torch.no_grad():
        layer.weight.copy_(weight)
    return layer


def test_contrast_is_a_sum_over_the_pixels_of_an_id():
    """Both ids agree with themselves: f is 0.5, x.u 1 or 0; a sum of 30 for each id, not a mean."""
    ids = torch.tensor([7] * 30 + [40_000] * 30)
    value = codebook.contrast(rows((30, X), (30, Y)), ids)
    assert float(value) == pytest.approx(30 * math.log(1 + math.exp(-2)), rel=1e-5) == pytest.approx(3.8078, abs=1e-4)
    scaled = codebook.contrast(rows((30, 5 * X), (30, 0.2 * Y)), ids)  # only directions count
    assert float(scaled) == pytest.approx(3.8078, abs=1e-4)


def test_ids_with_few_samples_take_no_part():
    ids = torch.tensor([3] * 20 + [7] * 30 + [9] * 30)
    drawn = rows((20, X + Y), (30, X), (30, Y)).requires_grad_()
    value = codebook.contrast(drawn, ids)
    value.backward()
    assert value.item() == pytest.approx(3.8078, abs=1e-4)
    assert drawn.grad is not None and not drawn.grad[:20].any() and bool(drawn.grad[20:].any())
    few = rows((20, X), (20, Y)).requires_grad_()
    nothing = codebook.contrast(few, torch.tensor([1] * 20 + [2] * 20))
    nothing.backward()
    assert nothing.item() == 0 and few.grad is not None and not few.grad.any()


def test_the_gradient_of_contrast():
    """The gradient is that of the formula as it is written, with norms and f held at their values."""
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(90, 3, generator=generator, dtype=torch.float64) + 0.5
    ids = torch.tensor([0] * 25 + [1] * 30 + [2] * 35)
    norm = drawn.norm(dim=1, keepdim=True) + 1e-6

    def means_of(x):
        return torch.stack([x[ids == c].mean(dim=0) for c in range(3)])

    means = means_of(drawn / norm)
    counts = torch.bincount(ids)
    spread = torch.stack([((drawn / norm)[ids == c] - means[c]).norm(dim=1).sum() for c in range(3)])
    f = (10 * spread / (counts * (counts + 10.0).log())).clamp(0.5, 1.0)

    def formula(values):
        x = values / norm
        scores = (x @ means_of(x).T / f).exp()
        own = scores.gather(1, ids[:, None])[:, 0]
        each = -(own / (scores.sum(dim=1) + 1e-6)).log()
        return sum(each[ids == c].sum() for c in range(3)) / 3

    found, wanted = (drawn.clone().requires_grad_() for _ in range(2))
    value, expected = codebook.contrast(found, ids), formula(wanted)
    torch.testing.assert_close(value, expected, rtol=1e-9, atol=0)
    value.backward()
    expected.backward()
    torch.testing.assert_close(found.grad, wanted.grad)
    assert (found.grad * drawn).sum(dim=1).abs().max() > 1e-3, "a norm that were no constant would leave nothing here"


def test_norms_of_labelled_pixels():
    drawn = torch.tensor([[3.0, 4.0], [0.0, 0.0], [0.0, 1.0], [9.0, 9.0]], requires_grad=True)
    value = codebook.norms(drawn, torch.tensor([True, True, True, False]))
    value.backward()
    assert float(value) == pytest.approx((16 + 1 + 0) / 3)
    assert drawn.grad is not None
    torch.testing.assert_close(drawn.grad[0], torch.tensor([1.6, 32 / 15]))
    assert not drawn.grad[1:].any(), "nothing drawn, already one, unlabelled"


@pytest.mark.parametrize("at_once", [1, 7, codebook.AT_ONCE])
def test_a_stray_pixel_is_not_reliable(monkeypatch, at_once):
    """Nine pixels of A agree, the tenth is B's: f is 0.1; their shares are .99988 and .000123."""
    monkeypatch.setattr(codebook, "AT_ONCE", at_once)
    drawn, group = rows((9, X), (11, Y)), torch.tensor([0] * 10 + [1] * 10)
    shares = codebook.own_shares(drawn, group, 2)
    torch.testing.assert_close(shares[:9], torch.full((9,), 0.99988), atol=1e-5, rtol=0)
    assert float(shares[9]) == pytest.approx(0.000123, abs=1e-6)
    assert codebook.reliable(drawn, group, 2).tolist() == [True] * 9 + [False] + [True] * 10


@pytest.mark.parametrize("at_once", [1, 8, codebook.AT_ONCE])
def test_large_masks_choose_their_code_first(monkeypatch, at_once):
    """Ten pixels of A prefer code 0 by .6 to .4, the only one of B by .9 to .1: sums give it to A, means to B."""
    monkeypatch.setattr(codebook, "AT_ONCE", at_once)
    drawn = torch.log(rows((10, torch.tensor([0.6, 0.4])), (1, torch.tensor([0.9, 0.1]))))
    group = torch.tensor([0] * 10 + [1])
    masses, largest = codebook.code_masses(lambda values: values, drawn, group, 2, 2)
    torch.testing.assert_close(masses, torch.tensor([[6.0, 4.0], [0.9, 0.1]]))
    assert largest.tolist() == [0] * 11
    assert codebook.matching(masses).tolist() == [0, 1]
    assert codebook.matching(masses / torch.tensor([[10.0], [1.0]])).tolist() == [1, 0]


def test_a_matching_of_fewer_ids_than_codes():
    assert codebook.matching(torch.tensor([[0.1, 0.2, 0.9, 0.3], [0.1, 0.3, 0.8, 0.0]])).tolist() == [2, 1]


@pytest.mark.parametrize("at_once", [1, 40, codebook.AT_ONCE])
def test_entropy_in_parts_is_that_of_all_pixels(monkeypatch, at_once):
    monkeypatch.setattr(codebook, "AT_ONCE", at_once)
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(50, 4, generator=generator).requires_grad_()
    layer = linear(torch.randn(6, 4, generator=generator))
    labels = torch.randint(6, (50,), generator=generator).int()
    labels[::7] = IGNORE
    weights = torch.randn(50, generator=generator)
    each = codebook.code_entropy(layer, drawn, labels, 6)
    (each * weights).sum().backward()
    again, weight = drawn.detach().clone().requires_grad_(), layer.weight.detach().clone().requires_grad_()
    logits = again @ weight.T
    known = labels != IGNORE
    expected = torch.where(known, logits.logsumexp(1) - logits.gather(1, (labels * known).long()[:, None])[:, 0], 0.0)
    (expected * weights).sum().backward()
    for found, wanted in ((each, expected), (drawn.grad, again.grad), (layer.weight.grad, weight.grad)):
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)


def test_the_losses_of_the_codebook():
    layer = linear(torch.zeros(256, 2))
    uniform = codebook.selection(layer, rows((3, X)), torch.tensor([0, 1, 2]), 256)
    assert float(uniform) == pytest.approx(1.0), "of uniform logits over 256 codes"
    weight = torch.stack([2 * X, 3 * Y]).requires_grad_()
    value = codebook.concentration(weight, rows((1, 7 * X), (1, 0.5 * Y), (1, X)), torch.tensor([0, 1, 1]))
    value.backward()
    assert float(value) == pytest.approx((1 + 2 + math.sqrt(10)) / 3, rel=1e-5)
    assert weight.grad is not None
    torch.testing.assert_close(weight.grad[0], X / 3, rtol=1e-4, atol=1e-6)
    assert float(codebook.concentration(weight, torch.zeros(0, 2), torch.zeros(0, dtype=torch.int64))) == 0


def test_a_code_belongs_to_the_class_of_most_of_its_pixels():
    """Seven of ten are not more than 0.7; several codes may be of one class; a code of no pixel is nobody's."""
    tables = torch.tensor([[7, 71, 0, 0, 5], [3, 29, 8, 0, 0], [0, 0, 2, 0, 0]])
    assert codebook.owners(tables).tolist() == [-1, 0, 1, -1, 0]


@pytest.mark.parametrize("at_once", [1, 6, codebook.AT_ONCE])
def test_members_of_codes(monkeypatch, at_once):
    """softmax: several objects or none; codes 1 and 2 are of the same object, whose probabilities do not add up."""
    monkeypatch.setattr(codebook, "AT_ONCE", at_once)
    owner = torch.tensor([0, 2, 2, 1, -1])
    shares = torch.tensor(
        [
            [0.90, 0.02, 0.02, 0.03, 0.03],
            [0.05, 0.40, 0.10, 0.35, 0.10],
            [0.10, 0.26, 0.27, 0.19, 0.18],
            [0.20, 0.05, 0.35, 0.20, 0.20],
            [0.10, 0.10, 0.10, 0.10, 0.60],
        ]
    )

    def classify(codes):
        return codes.log()

    found = codebook.members_by_softmax(classify, shares, owner, 3)
    assert {rank: mask.nonzero()[:, 0].tolist() for rank, mask in found.items()} == {1: [1], 2: [1, 3]}
    assert codebook.ranks_by_argmax(classify, shares, owner).tolist() == [0, 2, 2, 2, 0]


def test_threads_change_no_bit(for_threads):
    """Values and gradients of a view of 40,000 pixels."""

    def run() -> list[torch.Tensor]:
        generator = torch.Generator().manual_seed(0)
        drawn = torch.randn(40_000, 16, generator=generator).requires_grad_()
        layer = linear(torch.randn(256, 16, generator=generator))
        ids = torch.randint(5, (40_000,), generator=generator)
        places = codebook.sampled(40_000, generator)
        samples = torch.nn.functional.embedding(places, drawn)
        masses, largest = codebook.code_masses(layer, drawn.detach(), ids, 5, 256)
        targets = codebook.matching(masses)[ids]
        terms = [
            codebook.contrast(samples, ids[places]),
            codebook.norms(drawn, ids != 3),
            codebook.selection(layer, drawn.detach(), targets, 256),
            codebook.concentration(layer.weight, drawn.detach(), targets),
        ]
        torch.stack(terms).sum().backward()
        return [*terms, masses, largest, codebook.own_shares(drawn.detach(), ids, 5), drawn.grad, layer.weight.grad]

    assert all(torch.equal(first, each) for first, *rest in zip(*for_threads(run), strict=True) for each in rest)
