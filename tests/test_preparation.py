"""Preparation of refinement: which views vote, and what the others keep."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.errors import UserError
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import IGNORE, RasterSettings
from beags_plugin.refiners.none import NoRefiner
from beags_plugin.refiners.preparation import PreparationConfig, prepare

SIZE = 12
CAMERA = Camera(torch.eye(4), torch.tensor([[10.0, 0.0, 6.0], [0.0, 10.0, 6.0], [0.0, 0.0, 1.0]]), SIZE, SIZE)


def prepared(labels, **options):
    """Equal cameras that look at one wide disc; labels: a class id for each whole view, or None."""
    wide = Surfels.of(
        torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1, 2), 1.0),
        torch.tensor([3.0]), torch.zeros(1, 1, 3),
    )  # fmt: skip
    masks = [None if label is None else torch.full((SIZE, SIZE), label, dtype=torch.int32) for label in labels]
    config = PreparationConfig(k=1, **options)
    names = {0: "background", 1: "one", 2: "two"}
    rasterizer, settings = make_rasterizer("torch"), RasterSettings(0.1, 100.0)
    found = prepare(wide, [CAMERA] * len(masks), masks, names, rasterizer, settings, NoRefiner(), config)
    return [sorted(set(mask.unique().tolist())) for mask in found.labels]


def test_all_views_vote_unless_told_otherwise():
    assert prepared([1, 2, 2, 1, 2]) == [[2]] * 5
    assert prepared([1, 2, 2, 1, 2], voters=9) == [[2]] * 5


def test_voters_are_spread_over_the_views_that_have_masks():
    # a single voter is the one in the middle of those that have a mask
    assert prepared([1, None, 2, 2, 1, 2], voters=1) == [[2]] * 6
    assert prepared([1, 1, 2, 2, 1], voters=1) == [[2]] * 5


def test_without_a_decision_every_view_keeps_its_own():
    # the second and the fifth vote, against each other: a tie
    assert prepared([1, 1, 2, 1, 2, 2], voters=2) == [[1], [1], [2], [1], [2], [2]]
    assert prepared([1, 1, None, 2, 2], voters=2) == [[1], [1], [IGNORE], [2], [2]]


def test_doubtful_pixels_may_be_left_out():
    assert prepared([1, 2, 2, 1, 2], min_confidence=0.5) == [[2]] * 5  # 3 of 5 votes
    assert prepared([1, 2, 2, 1, 2], min_confidence=0.7) == [[IGNORE]] * 5


def test_wrong_options_are_refused():
    with pytest.raises(UserError, match="voters is -1"):
        PreparationConfig(voters=-1).check()
    with pytest.raises(UserError, match="min_confidence is 1.5"):
        PreparationConfig(min_confidence=1.5).check()


def test_k_follows_the_training_pixels_where_it_is_stated_for_more():
    cameras = [SimpleNamespace(height=100, width=200)] * 5  # 1e5 pixels
    assert PreparationConfig(k=2000).neighbours(cameras) == 2000
    assert PreparationConfig(k=2000, k_pixels=400_000).neighbours(cameras) == 500
    assert PreparationConfig(k=2000, k_pixels=50_000).neighbours(cameras) == 2000
    assert PreparationConfig(k=2000, k_pixels=10**9).neighbours(cameras) == 10
    assert PreparationConfig(k=4, k_pixels=10**9).neighbours(cameras) == 4
    with pytest.raises(UserError, match="k_pixels is -1"):
        PreparationConfig(k_pixels=-1).check()


def test_a_run_says_which_rounds_it_could_not_make():
    pytest.importorskip("nerfstudio")
    from beags_plugin.plugin.config import base_config
    from beags_plugin.plugin.refinement import RefinementSwitch

    config = base_config().model_config
    config.refine_steps = 3
    for rounds in (0, 4):
        config.refine_rounds = rounds
        with pytest.raises(UserError, match=f"refine_rounds is {rounds}: it must be 1 to refine_steps, which is 3"):
            RefinementSwitch(SimpleNamespace(config=config), None, None).check_options()
