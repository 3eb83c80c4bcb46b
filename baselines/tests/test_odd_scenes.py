"""The refiners that train codes or votes of their own, on scenes that lack what they count on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from trained_scenes import FAR_APART, loss_inputs, trained_scene

from beags_baselines import object_codebook
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.preparation.refiner_training import TrainedScene
from beags_plugin.refiners import make_refiner

REFINERS = {
    "instascene": {"min_gaussians": 5, "samples": 500},
    "opengaussian": {"coarse": 3, "fine": 2, "min_gaussians": 1, "min_leaf": 1},
    "unified-lift": {},
    "ilgs": {},
    "sagd": {},
}
STEPS = 12


def whole() -> TrainedScene:
    return trained_scene(steps=STEPS)


def one_view() -> TrainedScene:
    scene = whole()
    return replace(scene, cameras=scene.cameras[:1], labels=scene.labels[:1])


def class_without_pixels() -> TrainedScene:
    scene = whole()
    return replace(scene, names={**scene.names, 50_000: "absent"})


def one_class() -> TrainedScene:
    """All pixels are background."""
    scene = whole()
    return replace(scene, labels=[torch.zeros_like(labels) for labels in scene.labels])


def no_mask() -> TrainedScene:
    scene = whole()
    return replace(scene, labels=[torch.full_like(labels, IGNORE) for labels in scene.labels])


def broken() -> TrainedScene:
    """A centre that is no number, one at infinity, and a size that is."""
    scene = whole()
    with torch.no_grad():
        scene.surfels().means[0, 1], scene.surfels().means[1, 0] = math.nan, math.inf
        scene.surfels().log_scales[2, 0] = math.inf
    return scene


def one_gaussian() -> TrainedScene:
    scene = whole()
    surfels = scene.surfels().detach()
    alone = replace(surfels, **{name: values[:1].clone().requires_grad_() for name, values in vars(surfels).items()})
    return replace(scene, surfels=lambda: alone, class_ids=lambda: torch.full((1,), FAR_APART[1], dtype=torch.int32))


@pytest.mark.parametrize("name", REFINERS)
@pytest.mark.parametrize("odd", [one_view, class_without_pixels, one_class, no_mask, broken, one_gaussian])
def test_it_ends_well(name: str, odd: Callable[[], TrainedScene], monkeypatch):
    monkeypatch.setattr(object_codebook, "SAMPLES", 500)
    scene = odd()
    before = scene.surfels().detach().clone()
    refiner = make_refiner(name, REFINERS[name])
    training = refiner.own_training(scene)
    assert training is not None
    for step in range(STEPS if name != "sagd" else 1):
        training.before_step(step)
        terms = training.terms(loss_inputs(scene, step % len(scene.cameras)), step, dict)
        if terms:
            total = torch.stack(list(terms.values())).sum()
            assert torch.isfinite(total)
            total.backward()
        training.after_step(step)
    training.last_edit()
    found = training.finish()
    count = len(before)
    assert len(found.class_ids) == count and set(found.present()) <= set(FAR_APART)
    for class_id in scene.names:
        assert found.of(class_id).shape == (count,)
    if 50_000 in scene.names:
        assert not found.of(50_000).any()
    for parameter, values in vars(scene.surfels()).items():
        assert torch.equal(values.nan_to_num(), getattr(before, parameter).nan_to_num())
        if values.grad is not None:
            assert torch.isfinite(values.grad).all(), parameter
