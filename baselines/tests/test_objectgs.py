"""ObjectGS's training: its loss by hand, what it reaches, classes by three rules, with ids that lie far apart."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from trained_scenes import FAR_APART, loss_inputs, trained_scene

from beags_baselines.object_entropy import mean_area
from beags_baselines.objectgs import LabelledTraining, ObjectGsRefiner
from beags_baselines.ranked_labels import ranked_labels
from beags_plugin.assignment.contributions import contributions
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.preparation.refiner import AssignedScene
from beags_plugin.rasterizers.rendering import draw_features, surfel_inputs
from beags_plugin.system.errors import UserError


def terms_of(scene, masked: bool = True, **options) -> dict[str, torch.Tensor]:
    training = LabelledTraining(scene, ObjectGsRefiner(**options))
    return training.terms(loss_inputs(scene, masked=masked), 0, lambda: {"photometric": torch.zeros(())})


def entropy_by_hand(scene, counted, others: int = 0) -> torch.Tensor:
    """The mean over counted pixels of log sum_c exp(p_c) - p_M, with ``others`` classes that nobody has."""
    camera, labels = scene.cameras[0], scene.labels[0]
    one_hot = (scene.class_ids()[:, None] == torch.tensor(FAR_APART)).float()
    p = draw_features(
        scene.rasterizer, surfel_inputs(scene.surfels().detach(), camera), one_hot, camera, scene.settings
    )
    right = (labels[..., None] == torch.tensor(FAR_APART)).float()
    return ((p.exp().sum(dim=-1) + others).log() - (p * right).sum(dim=-1))[counted(labels)].mean()


def test_the_terms_and_what_they_reach():
    scene = trained_scene()
    scene.labels[0][:5] = IGNORE
    terms = terms_of(scene)
    assert set(terms) == {"photometric", "classes", "areas"}
    expected = 0.1 * entropy_by_hand(scene, lambda labels: labels != IGNORE)
    assert float(terms["classes"].detach()) == pytest.approx(float(expected), rel=1e-5)
    terms["classes"].backward()
    for name in ("means", "quats", "log_scales", "opacity_logits"):
        gradient = getattr(scene.surfels(), name).grad
        assert gradient.abs().max() > 1e-7 and not gradient[-1].any(), name  # the last one is seen by nobody
    objects = terms_of(scene, ignore_background=True, weight=2.0)["classes"]
    expected = 2.0 * entropy_by_hand(scene, lambda labels: (labels != IGNORE) & (labels != 0))
    assert float(objects.detach()) == pytest.approx(float(expected), rel=1e-5)


def test_areas_are_of_drawn_gaussians_in_units_of_the_input():
    scene = trained_scene(scale=0.5)
    drawn = loss_inputs(scene).render.visible
    assert not drawn[-1]
    area = mean_area(scene.surfels().log_scales.detach(), drawn) / 0.25
    assert float(terms_of(scene)["areas"].detach()) == pytest.approx(0.01 * float(area), rel=1e-5)


def test_no_mask_and_no_weight_leave_the_other_terms():
    scene = trained_scene()
    assert set(terms_of(scene, masked=False)) == {"photometric", "areas"}
    assert set(terms_of(scene, weight=0.0, scale_weight=0.0)) == {"photometric"}


def test_pixels_of_a_class_that_nobody_has_do_not_count():
    scene = trained_scene()
    strange = replace(scene, names={**scene.names, 9: "nobody's"}, labels=[each.clone() for each in scene.labels])
    strange.labels[0][scene.labels[0] == FAR_APART[1]] = 9
    counted = entropy_by_hand(scene, lambda labels: labels != FAR_APART[1], others=1)
    assert float(terms_of(strange)["classes"].detach()) == pytest.approx(0.1 * float(counted), rel=1e-5)


def test_phi_is_never_touched():
    scene = trained_scene()
    before, training = scene.class_ids().clone(), LabelledTraining(scene, ObjectGsRefiner())
    adam = torch.optim.Adam(list(vars(scene.surfels()).values()), lr=0.01)
    start = scene.surfels().clone()
    for step in range(9):
        adam.zero_grad()
        torch.stack(list(training.terms(loss_inputs(scene, step), step, dict).values())).sum().backward()
        adam.step()
    assert not torch.equal(scene.surfels().opacity_logits, start.opacity_logits)
    found = training.finish()
    assert found.objects is None and torch.equal(found.class_ids, before)


def test_classes_by_three_rules():
    scene = trained_scene()
    surfels, ranks = scene.surfels().clone(), ClassRanks(torch.tensor(FAR_APART))
    surfels.log_scales[0], surfels.opacity_logits[0] = 1.0, -2.0  # a faint veil far beyond its object
    ranked = [ranked_labels(ranks, labels) for labels in scene.labels]
    found = contributions(surfels, scene.cameras, ranked, scene.rasterizer, scene.settings, 3)
    found = replace(found, classes=ranks)
    assigned = AssignedScene(
        surfels, found.largest()[0], scene.cameras, scene.labels, FAR_APART[-1] + 1, FAR_APART[1:],
        scene.rasterizer, scene.settings, 0, found,
    )  # fmt: skip
    assert ObjectGsRefiner().members(assigned) is None  # labels stay as assigned
    labels = {rule: ObjectGsRefiner(labels=rule).members(assigned).class_ids for rule in ("majority", "nonzero")}
    e6 = assigned.class_ids
    assert torch.equal(labels["nonzero"][e6 != 0], e6[e6 != 0]) and (labels["nonzero"] == 0).sum() < (e6 == 0).sum()
    majority = labels["majority"]
    assert (majority == scene.class_ids())[:-1].float().mean() > 0.8 and majority[-1] == 0 and e6[-1] == 0
    assert e6[0] == 0 and majority[0] == FAR_APART[1] and set(majority.tolist()) == set(FAR_APART)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"labels": "votes"}, "votes"),
        ({"weight": -1.0}, "weight is -1: give the weight of a loss"),
        ({"scale_weight": float("nan")}, "scale_weight is nan"),
    ],
)
def test_a_wrong_option_is_said(options, sentence):
    with pytest.raises(UserError, match=sentence):
        ObjectGsRefiner(**options)
