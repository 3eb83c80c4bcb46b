"""Preparation of refinement: which views vote, and what the others keep."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from labelled_views import labelled_views
from raster_scenes import CLASSES

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.label_maps import LabelMaps
from beags_plugin.preparation import consistent_masks
from beags_plugin.preparation.consistent_masks import chosen_reprojection
from beags_plugin.preparation.pipeline import PreparationConfig, prepare
from beags_plugin.preparation.stages import StageStore
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.refiners.none import NoRefiner
from beags_plugin.system.errors import UserError

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


@pytest.mark.parametrize(
    ("views", "side", "masks", "voters", "expected"),
    [
        (60, (750, 1000), 60, 0, "pairwise"),
        (300, (750, 1000), 300, 0, "voxel"),  # 225 million pixels
        (130, (750, 1000), 130, 0, "voxel"),  # 97.5 million pixels, but 12.7 billion pairs
        (130, (750, 1000), 100, 0, "pairwise"),  # 9.75 billion: views without a mask do not vote
        (130, (750, 1000), 130, 100, "pairwise"),
        (500, (192, 256), 500, 0, "voxel"),  # 24.6 million pixels, 12.3 billion pairs
        (400, (192, 256), 400, 0, "pairwise"),
        (2, (10_000, 5_000), 1, 0, "pairwise"),  # 100 million pixels
        (2, (10_000, 5_001), 1, 0, "voxel"),
    ],
)
def test_auto_is_pairwise_where_its_time_and_memory_are_small(views, side, masks, voters, expected):
    cameras = [SimpleNamespace(height=side[0], width=side[1])] * views
    labels = LabelMaps(torch.zeros(2, 2, dtype=torch.int32) if view < masks else None for view in range(views))
    name, why = chosen_reprojection("auto", voters, cameras, labels)
    pixels, pairs = views * side[0] * side[1] / 1e6, (voters or masks) * views * side[0] * side[1] / 1e9
    assert name == expected and why is not None and "\n" not in why
    assert f"reprojection {expected}: {views} views have {pixels:.3g} million pixels, {pairs:.3g} billion pairs" in why
    for stated in ("pairwise", "voxel", "of another package"):
        assert chosen_reprojection(stated, voters, cameras, labels) == (stated, None)


def test_what_auto_chose_is_what_the_stages_are_kept_for(tmp_path, monkeypatch):
    surfels, cameras, masks, rasterizer, settings = labelled_views(5, 0.1)
    names = {index: str(index) for index in range(CLASSES)}

    def of(name):
        config = PreparationConfig(reprojection=name, k=20)
        refiner, store = NoRefiner(), StageStore(tmp_path)
        return prepare(surfels, cameras, masks, names, rasterizer, settings, refiner, config, store=store)

    stated = {name: of(name) for name in ("voxel", "pairwise")}
    few = of("auto")
    assert any(line.startswith("reprojection pairwise: 5 views") for line in few.findings)
    assert any("labelled pixels changed" in line and "kept from before" in line for line in few.findings)
    monkeypatch.setattr(consistent_masks, "PAIRWISE_PIXELS", 1)
    many = of("auto")
    assert any(line.startswith("reprojection voxel: 5 views") for line in many.findings)
    assert not any("labelled pixels changed" in line and "kept from before" in line for line in many.findings)
    assert any("labelled pixels changed" in line and "kept from before" in line for line in of("voxel").findings)
    assert not any(line.startswith("reprojection voxel") for line in stated["voxel"].findings)
    for found, name in ((few, "pairwise"), (many, "voxel")):
        assert all(torch.equal(a, b) for a, b in zip(found.labels, stated[name].labels, strict=True))
        assert all(torch.equal(a, b) for a, b in zip(found.confidence, stated[name].confidence, strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(few.confidence, many.confidence, strict=True))


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
    from beags_plugin.plugin.options.config import base_config
    from beags_plugin.plugin.training.refinement import RefinementSwitch

    config = base_config().model_config
    config.refine_steps = 3
    for rounds in (0, 4):
        config.refine_rounds = rounds
        with pytest.raises(UserError, match=f"refine_rounds is {rounds}: it must be 1 to refine_steps, which is 3"):
            RefinementSwitch(SimpleNamespace(config=config), None, None).check_options()
