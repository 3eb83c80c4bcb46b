"""COB-GS on a scene whose steps change nothing: what its mask phases do, in which order, and what the objects are."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from drawn_discs import camera, discs
from owned_scenes import OwnedScene
from run_folders import drawn_labels, ring_cameras

from beags_baselines import flashsplat
from beags_baselines.cob_gs import CobGsRefiner, CobGsTraining
from beags_plugin.assignment.contributions import contributions
from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.refiners import make_refiner
from beags_plugin.system.errors import UserError


def noisy_labels() -> list[torch.Tensor]:
    """The class maps of 24 views with 40 % of their pixels wrong, so that no share is far from a half."""
    maps = [drawn_labels(camera) for camera in ring_cameras(24, 4)]
    right = torch.rand(len(maps), *maps[0].shape, generator=torch.Generator().manual_seed(0)) < 0.6
    return [torch.where(keep, labels, (labels + 1) % 3).int() for keep, labels in zip(right, maps, strict=True)]


@pytest.mark.parametrize(("class_id", "name"), [(1, "cup"), (2, "box")])
def test_without_edits_the_object_is_flashsplats_argmax(class_id, name):
    held = OwnedScene(labels=noisy_labels())
    views = (held.cameras, held.labels, held.scene.rasterizer, held.scene.settings)
    shares = contributions(held.surfels, *views, 3)
    expected = flashsplat.members(shares.of(class_id), shares.total(), 0.0)
    members = held.run(CobGsRefiner(object=name, tau=0.0)).finish()
    assert members is not None and members.present() == [0, class_id] and len(held.surfels) == 75
    found = members.of(class_id)
    assert int(expected.sum()) == 25 and int((found & expected).sum()) > 0.95 * int((found | expected).sum())


def test_objects_take_turns_in_one_scene():
    held = OwnedScene(views=7)
    own = held.run(CobGsRefiner(epochs=10))
    assert isinstance(own, CobGsTraining) and held.scene.steps == 2 * 7 * 2 * 2
    areas = [sum(int((labels == c).sum()) for labels in held.labels) for c in (1, 2)]
    assert own.objects == ([1, 2] if areas[0] > areas[1] else [2, 1])
    assert [edit.fresh_adam for edit in held.edits] == [True, False, True, False, False]
    edits = [edit.edited for edit in held.edits if edit.edited is not None]
    before = 75
    for place, edited in enumerate(edits):
        children, kept = int(edited.fresh.sum()), len(torch.unique(edited.source))
        assert (children > 0) == (place < 4), "the last phase of all removes only"
        if place in (2, 4):
            assert kept < before, "an object's last phase removes"
        else:
            assert kept == before == len(edited.surfels) - children // 2
        before = len(edited.surfels)
    members = own.finish()
    assert members is not None and len(members) == before and members.present() == [0, 1, 2]
    for class_id, x in ((1, -0.5), (2, 0.5)):
        assert float(held.surfels.means[members.of(class_id), 0].mean()) == pytest.approx(x, abs=0.1)


def held_row(extent: float) -> OwnedScene:
    """The specification's five discs of sigma 4 px in 24 views that are alike: across the border of the mask, which is
    right of column 32, near it, inside, and behind the camera. They overlap, which changes no count.
    """
    inputs, view = discs(64, [(x, 32) for x in (32, 36, 38, 46, 46)], 4.0, 0.8), camera(64)
    inputs.means[4, 2] = -1.0
    values = (inputs.means, inputs.quats, inputs.log_scales, inputs.opacity_logits, torch.zeros(5, 4, 3))
    labels = (torch.arange(64) >= 32).int().repeat(64, 1)
    held = OwnedScene(24, [labels] * 24, surfels=Surfels.of(*(each.float() for each in values)))
    held.cameras[:] = [Camera(view.viewmat.float(), view.K.float(), 64, 64)] * 24
    held.scene = replace(held.scene, extent=extent)
    return held


@pytest.mark.parametrize(("extent", "splits"), [(3.9, True), (4.1, False)])
def test_a_phase_splits_what_is_mixed_and_large_and_the_last_removes_it(extent, splits):
    """A disc is 0.04 wide; what must exceed 0.01 of the extent for a split may be of any size for removal."""
    for tau, mixed in ((0.5, [0, 1]), (0.8, [0, 1, 2])):
        held = held_row(extent)
        split = CobGsRefiner(object="cup", tau=tau).own_training(held.scene).before_step(0)
        assert split is not None and split.edited is not None
        kept = [i for i in range(5) if i not in mixed]
        children = [i for i in mixed for _ in range(2)]
        assert sorted(split.edited.source.tolist()) == (sorted(kept + children) if splits else [0, 1, 2, 3, 4])
        assert sorted(split.edited.source[split.edited.fresh].tolist()) == (children if splits else [])

        own = CobGsRefiner(object="cup", tau=tau).own_training(held.scene)  # a run of one phase, which is the last
        held.take(own.last_edit())
        (removal,) = held.edits
        assert removal.edited is not None and removal.edited.source.tolist() == kept
        assert not removal.edited.fresh.any()
        members = own.finish()
        assert members is not None and members.of(1).tolist() == [True] * (len(kept) - 1) + [False]
        assert own.state()["logits"]["logits"][-1] == 0.0, "what no view shows stays where it began"


def test_an_object_of_its_own_keeps_adam_and_has_the_steps_of_one():
    held = OwnedScene(views=7)
    members = held.run(CobGsRefiner(object="box", epochs=6)).finish()
    assert held.scene.steps == 14 and [edit.fresh_adam for edit in held.edits] == [False, False]
    assert members is not None and members.present() == [0, 2]


def test_views_without_labels_take_part_in_no_mask_phase():
    """They count in no mean and in no step, but are views of the texture phases."""
    without = {3, 5}
    maps = [drawn_labels(camera) for camera in ring_cameras(7, 4)]
    held = OwnedScene(7, [torch.full_like(each, IGNORE) if v in without else each for v, each in enumerate(maps)])
    alone = OwnedScene(7, [each for v, each in enumerate(maps) if v not in without])
    alone.cameras[:] = [each for v, each in enumerate(alone.cameras) if v not in without]
    scenes = (held, alone)
    trainings = [CobGsRefiner(epochs=6).own_training(each.scene) for each in scenes]
    for each, own in zip(scenes, trainings, strict=True):
        each.take(own.before_step(0))
    assert torch.equal(held.surfels.means, alone.surfels.means) and len(held.surfels) > 75
    assert torch.equal(trainings[0].state()["logits"]["logits"], trainings[1].state()["logits"]["logits"])
    assert trainings[0].before_step(10) is None is not trainings[1].before_step(10)  # 14 and 10 steps to a phase


def test_rates_and_steps_are_the_sources():
    rates = CobGsRefiner().own_training(OwnedScene(7).scene).rates(3)
    expected = {"features_dc": 0.0025, "features_rest": 0.000125, "opacities": 0.025, "scales": 0.005, "quats": 0.001}
    assert rates == {**expected, "means": pytest.approx(1.6e-6 * 3.0)}
    assert CobGsRefiner().steps(99, views=300, objects=4) == 4 * 6 * 300  # three texture phases of two epochs
    assert CobGsRefiner(object="cup", epochs=22).steps(99, views=300, objects=4) == 10 * 300


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        *(({"epochs": epochs}, f"epochs is {epochs}: give 6, 10") for epochs in (0, 2, 7, 12)),
        ({"tau": 1.5}, "tau is 1.5"),
        ({"threshold": -0.5}, "threshold is -0.5"),
        ({"outside_weight": -1}, "outside_weight is -1"),
        ({"order": "area"}, "no order of objects 'area'"),
    ],
)
def test_options_that_cannot_work(options, sentence):
    with pytest.raises(UserError, match=sentence):
        make_refiner("cob-gs", options)


def test_an_object_is_a_class_but_the_background():
    names = {0: "background", 1: "cup", 7: "7"}
    make_refiner("cob-gs", {"object": 7}).check(names)  # a command line reads this number
    for name in ("cap", "background"):
        with pytest.raises(UserError, match=f"no object '{name}'.*choose one of cup, 7"):
            make_refiner("cob-gs", {"object": name}).check(names)
