"""Preparation of refinement: who votes, and what is refused."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest
import torch
from labelled_views import labelled_views
from raster_scenes import CLASSES

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import TAU
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.label_maps import LabelMaps
from beags_plugin.options.stages import PreparationConfig
from beags_plugin.preparation import consistent_masks
from beags_plugin.preparation.agreed import AgreementReport
from beags_plugin.preparation.consistent_masks import chosen_reprojection
from beags_plugin.preparation.pipeline import check_options, neighbours, prepare
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import SURFACE_DEPTHS
from beags_plugin.refiners.none import NoRefiner
from beags_plugin.system.errors import UserError

SIZE = 12
CAMERA = Camera(torch.eye(4), torch.tensor([[10.0, 0.0, 6.0], [0.0, 10.0, 6.0], [0.0, 0.0, 1.0]]), SIZE, SIZE)


def prepared(labels, **options):
    """Prepare equal cameras that look at one wide disc; labels: a class id for each whole view, a mask, or None."""
    wide = Surfels.of(
        torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1, 2), 1.0),
        torch.tensor([3.0]), torch.zeros(1, 1, 3),
    )  # fmt: skip
    masks = [
        torch.full((SIZE, SIZE), label, dtype=torch.int32) if isinstance(label, int) else label for label in labels
    ]
    config = PreparationConfig(k=1, **options)
    names = {0: "background", 1: "one", 2: "two"}
    rasterizer, settings = make_rasterizer("torch"), RasterSettings(0.1, 100.0)
    return prepare(wide, [CAMERA] * len(masks), masks, names, rasterizer, settings, NoRefiner(), config)


def classes_of(labels, **options):
    """Return the classes in each view's mask."""
    found = prepared(labels, **options)
    return [sorted(set(mask.unique().tolist())) for mask in found.labels]


def test_all_views_vote():
    assert classes_of([1, 2, 2, 1, 2]) == [[2]] * 5


def test_a_view_without_a_mask_gets_what_the_others_vote_and_in_a_tie_each_keeps_its_own():
    assert classes_of([1, None, 2, 2]) == [[2]] * 4
    assert classes_of([1, None, 2]) == [[1], [IGNORE], [2]]


def test_a_mask_that_contradicts_the_others_is_overruled_where_agreement_is_asked_for():
    assert classes_of([1, 1, 1, 1, 2], reprojection="none") == [[1]] * 4 + [[2]]
    assert classes_of([1, 1, 1, 1, 2], reprojection="none", agree=True) == [[1]] * 5


def test_pixels_in_doubt_stay_unlabelled_in_the_masks_that_training_uses():
    """The others give the disc to class 2 in 7 of 12 columns, which is too little to be sure of it."""
    halves = torch.ones(SIZE, SIZE, dtype=torch.int32)
    halves[:, 5:] = 2
    labels = [None, halves, halves, halves]
    assert classes_of(labels) == [[1, 2]] * 4
    found = prepared(labels, agree=True)
    assert found.agreement is not None and found.agreement.doubtful == [1.0, 0.0, 0.0, 0.0]
    assert found.confidence is not None and not found.confidence[0].any() and found.confidence[1].all()
    assert [float((mask == IGNORE).float().mean()) for mask in found.labels] == found.agreement.doubtful


def test_the_report_of_agreement_holds_no_nan_and_names_misplaced_views():
    report = AgreementReport([0.25, None, 0.6, 0.3], [2], [0.0] * 4, [0.0, 0.0, 0.5, 0.1], None, [3])
    written = json.loads(json.dumps(report.to_json(["a", "b", "c", "d"]), allow_nan=False))
    assert written["agreement"] == pytest.approx(1 - 1.15 / 3, abs=1e-4) and written["masks"] == 3
    assert written["overruled"] == ["c"] and written["misplaced"] == ["d"]
    assert written["views"][1]["contradicts"] is None
    first = report.of_first(3)
    assert first.misplaced == [] and first.overruled == [2] and len(first.errors) == 3
    assert "the photos of 1 of 3 masks seem to have wrong poses (d)" in report.sentence(list("abcd"))
    assert "poses" not in first.sentence()


@pytest.mark.parametrize(
    ("views", "side", "masks", "expected"),
    [
        (30, (750, 1000), 30, "pairwise"),
        (300, (750, 1000), 300, "voxel"),  # 225 million pixels
        (40, (750, 1000), 40, "voxel"),  # 30 million pixels, but 1.2 billion pairs
        (40, (750, 1000), 33, "pairwise"),  # 0.99 billion: views without a mask do not vote
        (150, (192, 256), 150, "voxel"),  # 7.4 million pixels, 1.1 billion pairs
        (140, (192, 256), 140, "pairwise"),
        (2, (10_000, 5_000), 1, "pairwise"),  # 100 million pixels
        (2, (10_000, 5_001), 1, "voxel"),
    ],
)
def test_auto_is_pairwise_where_its_time_and_memory_are_small(views, side, masks, expected):
    cameras = [SimpleNamespace(height=side[0], width=side[1])] * views
    labels = LabelMaps(torch.zeros(2, 2, dtype=torch.int32) if view < masks else None for view in range(views))
    name, why = chosen_reprojection("auto", cameras, labels)
    pixels, pairs = views * side[0] * side[1] / 1e6, masks * views * side[0] * side[1] / 1e9
    assert name == expected and why is not None and "\n" not in why
    assert f"reprojection {expected}: {views} views have {pixels:.3g} million pixels, {pairs:.3g} billion pairs" in why
    for stated in ("pairwise", "voxel", "of another package"):
        assert chosen_reprojection(stated, cameras, labels) == (stated, None)


def test_auto_gives_what_the_method_that_it_chose_gives(monkeypatch):
    surfels, cameras, masks, rasterizer, settings = labelled_views(5, 0.1)
    names = {index: str(index) for index in range(CLASSES)}

    def of(name):
        config = PreparationConfig(reprojection=name, k=20)
        return prepare(surfels, cameras, masks, names, rasterizer, settings, NoRefiner(), config)

    stated = {name: of(name) for name in ("voxel", "pairwise")}
    few = of("auto")
    assert any(line.startswith("reprojection pairwise: 5 views") for line in few.summary)
    monkeypatch.setattr(consistent_masks, "PAIRWISE_PIXELS", 1)
    many = of("auto")
    assert any(line.startswith("reprojection voxel: 5 views") for line in many.summary)
    assert not any(line.startswith("reprojection voxel") for line in stated["voxel"].summary)
    for found, name in ((few, "pairwise"), (many, "voxel")):
        assert all(torch.equal(a, b) for a, b in zip(found.labels, stated[name].labels, strict=True))
        assert all(torch.equal(a, b) for a, b in zip(found.confidence, stated[name].confidence, strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(few.confidence, many.confidence, strict=True))


def test_k_follows_the_training_pixels_where_it_is_stated_for_more():
    cameras = [SimpleNamespace(height=100, width=200)] * 5  # 1e5 pixels
    assert neighbours(PreparationConfig(k=2000), cameras) == 2000
    assert neighbours(PreparationConfig(k=2000, k_pixels=400_000), cameras) == 500
    assert neighbours(PreparationConfig(k=2000, k_pixels=50_000), cameras) == 2000
    assert neighbours(PreparationConfig(k=2000, k_pixels=10**9), cameras) == 10
    assert neighbours(PreparationConfig(k=4, k_pixels=10**9), cameras) == 4
    with pytest.raises(UserError, match="k_pixels is -1"):
        check_options(PreparationConfig(k_pixels=-1))


def test_defaults_that_options_repeat_are_those_of_the_stages():
    """Options import no maths."""
    config = PreparationConfig()
    assert (config.tau, config.reprojection) == (TAU, consistent_masks.AUTO) and config.depth in SURFACE_DEPTHS
