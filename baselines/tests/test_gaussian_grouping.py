"""Gaussian Grouping's training: what its losses reach and move, the objects it leaves, with ids that lie far apart."""

from __future__ import annotations

import pytest
import torch
from trained_scenes import FAR_APART, loss_inputs, stepped, trained_scene

from beags_baselines.gaussian_grouping import GaussianGroupingRefiner, IdentityTraining
from beags_plugin.system.errors import UserError


def trained(steps: int = 0, **options) -> IdentityTraining:
    training = IdentityTraining(trained_scene(), GaussianGroupingRefiner(**options))
    stepped(training, range(steps), geometry=True)
    return training


def test_the_masks_reach_codes_classifier_and_geometry():
    training = trained()
    scene, before = training.scene, training.learned.codes.detach().clone()
    training.before_step(1)
    terms = training.terms(loss_inputs(scene), 1, lambda: {"photometric": torch.zeros(())})
    assert set(terms) == {"photometric", "identities"}
    terms["identities"].backward()
    surfels = scene.surfels()
    for name in ("means", "quats", "log_scales", "opacity_logits"):
        gradient = getattr(surfels, name).grad
        assert gradient.abs().max() > 1e-6 and not gradient[-1].any(), name
    assert surfels.sh_dc.grad is None or not surfels.sh_dc.grad.any()  # codes are drawn in place of colours
    training.after_step(1)
    moved = (training.learned.codes.detach() != before).any(dim=1)
    assert moved[:-1].sum() > 60 and not moved[-1]  # the last one is seen by nobody
    assert all(values.grad.any() for values in training.learned.classifier.parameters())


def test_neighbours_come_every_fifth_step_and_leave_the_geometry():
    training = trained()
    training.before_step(5)
    found = {step: training.terms(loss_inputs(training.scene), step, dict) for step in range(5, 11)}
    assert [step for step, terms in found.items() if "neighbours" in terms] == [5, 10]
    (early,), (late,) = (torch.autograd.grad(found[step]["neighbours"], [training.learned.codes]) for step in (5, 10))
    assert early[-1].any() and not torch.equal(early, late)  # other anchors
    found[5] = training.terms(loss_inputs(training.scene), 5, dict)
    found[5]["neighbours"].backward()
    assert training.scene.surfels().means.grad is None


def test_a_step_without_mask_and_neighbours_leaves_all_as_it_is():
    training = trained(3)
    before = [values.detach().clone() for values in training.learned.parameters]
    stepped(training, range(6, 9), masked=False, geometry=True)
    assert all(torch.equal(values, old) for values, old in zip(training.learned.parameters, before, strict=True))
    stepped(training, range(10, 11), masked=False, geometry=True)
    assert not any(torch.equal(values, old) for values, old in zip(training.learned.parameters, before, strict=True))


def test_short_runs_learn_faster():
    rates = [[group["lr"] for group in trained().learned.adam.param_groups]]
    training = IdentityTraining(trained_scene(steps=15_000), GaussianGroupingRefiner())
    rates.append([group["lr"] for group in training.learned.adam.param_groups])
    assert rates == [pytest.approx([0.025, 0.005]), pytest.approx([0.005, 0.001])]
    assert [group["eps"] for group in training.learned.adam.param_groups] == [1e-15, 1e-8]


def test_codes_learn_the_masks_and_leave_objects_that_overlap(capsys):
    training = trained(200, hull=False)
    assert training.figures() == {}
    found, scene = training.finish(), training.scene
    printed = f"codes: {training.figures()['labelled_share']:.1%} of the labelled pixels of training views get their"
    assert f"{printed} class\n" in capsys.readouterr().out and 0.97 <= training.figures()["labelled_share"] <= 1.0
    assert sorted(found.objects) == list(FAR_APART[1:])
    for class_id in FAR_APART[1:]:
        own = scene.class_ids() == class_id
        assert found.of(class_id)[own].float().mean() > 0.8 > 0.5 > found.of(class_id)[~own].float().mean()
    everything = IdentityTraining(scene, GaussianGroupingRefiner(threshold=0.0))
    everything.restore(training.state())
    overlapping = everything.finish()
    assert all(len(each) == len(training.learned.codes) for each in overlapping.objects.values())
    assert set(overlapping.class_ids.tolist()) == set(FAR_APART[1:])


def test_what_has_learned_too_little_says_so(capsys):
    trained(1).finish()
    assert "below 97%: train longer (refine_steps)" in capsys.readouterr().out


def test_a_threshold_is_a_probability():
    with pytest.raises(UserError, match=r"threshold is 1.3: give a probability"):
        GaussianGroupingRefiner(threshold=1.3)
