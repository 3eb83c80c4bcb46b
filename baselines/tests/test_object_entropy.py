"""ObjectGS's object loss: the specification's numbers through the reference rasterizer, and what does not count."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from drawn_discs import camera, discs, drawn

from beags_baselines.object_entropy import counted_labels, label_entropy, mean_area
from beags_plugin.labels.class_ids import IGNORE

K = 3


def two_layers():
    """One pixel; wide discs of class 1 (alpha 0.5) before class 2 (alpha 0.8): logits of opacity, and p [1, 1, 3]."""
    inputs = discs(1, [(0.5, 0.5)] * 2, 300.0, [0.5, 0.8], depths=[1.0, 2.0])
    one_hot = torch.eye(K, dtype=torch.float64)[[1, 2]]
    opacity_logits = inputs.opacity_logits.requires_grad_()
    return opacity_logits, drawn(replace(inputs, colors=one_hot), camera(1)).color


def pixel(class_id: int) -> torch.Tensor:
    return torch.tensor([[class_id]], dtype=torch.int32)


def test_two_layers_over_a_pixel():
    opacity_logits, p = two_layers()
    assert p.flatten().tolist() == pytest.approx([0.0, 0.5, 0.4])
    assert p.detach().softmax(dim=-1).flatten().tolist() == pytest.approx([0.241514, 0.398189, 0.360297], abs=1e-6)
    loss = label_entropy(p, pixel(1))
    assert float(loss.detach()) == pytest.approx(0.920828, abs=1e-6)
    wrong = [float(-(p.detach()[0, 0, 1] / divisor).log()) for divisor in (1.0, 0.9)]
    assert wrong == pytest.approx([0.6931, 0.5878], abs=5e-5)  # ports that take p or p / A for probabilities
    p.retain_grad()
    loss.backward()
    assert p.grad.flatten().tolist() == pytest.approx([0.241514, 0.398189 - 1.0, 0.360297], abs=1e-6)  # G = dL/dp
    to_logits = torch.tensor([0.25, 0.16], dtype=torch.float64)
    by_alpha = opacity_logits.grad / to_logits
    assert by_alpha.tolist() == pytest.approx([-0.890048, 0.180148], abs=1e-6)
    # the front one's: its own class, and that it hides the other
    assert [float(p.grad[0, 0, 1]), -0.8 * float(p.grad[0, 0, 2])] == pytest.approx([-0.6018, -0.2882], abs=5e-5)


def test_background_is_one_more_object_or_does_not_count():
    opacity_logits, p = two_layers()
    assert float(label_entropy(p.detach(), counted_labels(pixel(0)))) == pytest.approx(1.420828, abs=1e-6)
    loss = label_entropy(p, counted_labels(pixel(0), ignore_background=True))
    loss.backward()
    assert float(loss.detach()) == 0.0 and not opacity_logits.grad.any()


def test_a_perfect_pixel_is_still_pulled():
    p = torch.tensor([[[0.0, 1.0, 0.0]]], dtype=torch.float64, requires_grad=True)
    loss = label_entropy(p, pixel(1))
    loss.backward()
    assert float(loss.detach()) == pytest.approx(0.551445, abs=1e-6)
    assert float(p.grad[0, 0, 1]) == pytest.approx(-0.423883, abs=1e-6)


def test_unlabelled_pixels_do_not_count_and_no_pixel_is_no_nan():
    p = torch.rand(2, 3, K, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_()
    labels = torch.tensor([[0, 1, IGNORE], [2, IGNORE, 1]], dtype=torch.int32)
    counted = ((0, 0), (0, 1), (1, 0), (1, 2))
    alone = [label_entropy(p.detach()[at][None, None], labels[at][None, None]) for at in counted]
    assert float(label_entropy(p.detach(), labels)) == pytest.approx(float(sum(alone)) / 4)
    assert float(label_entropy(p.detach(), None)) == 0.0
    loss = label_entropy(p, torch.full_like(labels, IGNORE))
    loss.backward()
    assert float(loss.detach()) == 0.0 and not p.grad.any()

    without_two = counted_labels(labels, torch.tensor([True, True, False]))
    assert without_two.tolist() == [[0, 1, IGNORE], [IGNORE, IGNORE, 1]]
    assert counted_labels(labels, torch.tensor([True, True, False]), True).tolist() == [
        [IGNORE, 1, IGNORE],
        [IGNORE, IGNORE, 1],
    ]


def test_the_area_is_that_of_drawn_gaussians():
    log_scales = torch.tensor([[0.1, 0.2], [3.0, 0.5], [100.0, 1e30]]).log().requires_grad_()
    area = mean_area(log_scales, torch.tensor([True, True, False]))
    area.backward()
    assert float(area.detach()) == pytest.approx((0.02 + 1.5) / 2)
    assert log_scales.grad.tolist() == [pytest.approx([0.01] * 2), pytest.approx([0.75] * 2), [0.0, 0.0]]
    assert float(mean_area(log_scales.detach(), torch.zeros(3, dtype=torch.bool))) == 0.0
    assert math.isfinite(float(mean_area(log_scales.detach()[:0], torch.zeros(0, dtype=torch.bool))))
