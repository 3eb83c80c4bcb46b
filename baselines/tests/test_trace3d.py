"""Trace3D on a scene whose steps change nothing: what is split, what is pruned, what the objects are."""

from __future__ import annotations

import pytest
import torch
from owned_scenes import OwnedScene
from run_folders import discs, ring_cameras

from beags_baselines.trace3d import RATES, Trace3DRefiner
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers.rendering import geometry_inputs
from beags_plugin.refiners import make_refiner
from beags_plugin.system.errors import UserError


def with_one_behind(surfels: Surfels) -> Surfels:
    """Return the discs, and before them one that no view composites because it is far below."""
    hidden = surfels[:1].clone()
    hidden.means[:] = torch.tensor([[0.0, 0.0, -50.0]])
    return Surfels(*(torch.cat(pair) for pair in zip(vars(hidden).values(), vars(surfels).values(), strict=True)))


@pytest.mark.parametrize("weights", ["count", "alpha"])
def test_hidden_gaussians_count_whole_pixels_unless_weights_count(weights):
    """Only counts see that a disc shows behind others, where weights are too small for a split."""
    held = OwnedScene(surfels=with_one_behind(discs()[0]), steps=1_000)
    members = held.run(Trace3DRefiner(weights=weights)).finish()
    edits = [edit.edited for edit in held.edits if edit.edited is not None]
    assert held.edits[0].fresh_adam and len(edits) == 5  # the first step and cycle coincide; the last prunes
    assert 0 not in edits[0].source.tolist(), "nobody sees it"
    assert bool(edits[0].fresh.any()) == (weights == "count")
    assert members is not None and members.objects is None and members.present() == [0, 1, 2]
    for class_id, x in ((1, -0.5), (2, 0.5)):
        inside = held.surfels.means[members.of(class_id)]
        assert len(inside) >= 25 and float(inside[:, 0].mean()) == pytest.approx(x, abs=0.1)


def test_members_are_by_the_pixels_or_weights_of_all_views():
    held, found = OwnedScene(views=7), []
    inputs, rasterizer = geometry_inputs(held.surfels), held.scene.rasterizer
    products = {"count": rasterizer.sparse_class_pixel_counts, "alpha": rasterizer.sparse_class_contributions}
    for weights, product in products.items():
        table = torch.zeros(75 * 3)
        for camera, labels in zip(held.cameras, held.labels, strict=True):
            keys, values = product(inputs, camera, held.scene.settings, labels, 3)
            table[keys] += values
        largest, class_ids = (table.view(75, 3) / table.view(75, 3).sum(dim=1, keepdim=True)).max(dim=1)
        members = Trace3DRefiner(weights=weights, member_share=0.8).own_training(held.scene).finish()
        assert members is not None and torch.equal(members.class_ids, class_ids.where(largest > 0.8, 0).int())
        found.append(members.class_ids)
    assert not torch.equal(*found)


def test_a_step_before_an_edit_trains_nothing():
    own = Trace3DRefiner().own_training(OwnedScene(views=7, steps=9_000).scene)
    base = {"photometric": torch.ones(())}
    skipped = [step for step in range(9_000) if not own.terms(None, step, lambda: base)]  # pyright: ignore
    assert skipped == [0, 9, 1_209, 2_409, 3_609, 8_999]
    assert own.terms(None, 1, lambda: base) is base  # pyright: ignore


def test_where_everything_is_ambiguous_one_gaussian_remains():
    """The classes take turns from pixel to pixel."""
    camera = ring_cameras(1, 4)[0]
    rows, columns = torch.arange(camera.height)[:, None], torch.arange(camera.width)
    held = OwnedScene(7, [((rows + columns) % 3).int()] * 7)
    members = held.run(Trace3DRefiner(min_pixels=5)).finish()
    assert len(held.surfels) == 1 and members is not None and members.present() == [0]


def test_rates_are_the_sources():
    scene = OwnedScene(views=7, steps=9_000).scene
    assert Trace3DRefiner().own_training(scene).rates(4_000) == {**RATES, "means": 0.0}
    intended = Trace3DRefiner(position_lr="intended").own_training(scene).rates(8_999)
    assert intended == {**RATES, "means": pytest.approx(3.0 * 4.02e-5, rel=1e-3)}
    assert list(RATES.values()) == [0.0025, 0.000125, 0.05, 0.005, 0.001]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"weights": "alphas"}, "did you mean alpha"),
        ({"position_lr": "none"}, "choose one of released, intended"),
        ({"min_pixels": -1}, "min_pixels is -1"),
        ({"min_share": 1.1}, "min_share is 1.1: give a share, 0 to 1"),
        ({"max_ambiguous": -0.1}, "max_ambiguous is -0.1"),
        ({"member_share": 0.4}, "member_share is 0.4: give a share, 0.5 to 1"),
    ],
)
def test_options_that_cannot_work(options, sentence):
    with pytest.raises(UserError, match=sentence):
        make_refiner("trace3d", options)
