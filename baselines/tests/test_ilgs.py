"""ILGS's loss with its bound, what it does to the geometry, its hull, and the objects it leaves."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from drawn_discs import camera, discs
from trained_scenes import FAR_APART, loss_inputs, stepped, trained_scene

from beags_baselines import ilgs
from beags_baselines.ilgs import IlgsRefiner, IlgsTraining, inside_hull, trusted_mean
from beags_baselines.object_codebook import code_entropy
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import draw_features
from beags_plugin.rasterizers.torch_reference import TorchRasterizer
from beags_plugin.system.errors import UserError

LN = math.log(256)


@pytest.mark.parametrize(("share", "expected"), [(0.0, 0.18034), (0.5, 0.18034), (1.0, 0.04508)])
def test_the_bound_falls_to_the_mean(share, expected):
    """Mean 1: the bound is 2, 1.5, which is not above itself, and 1; pixels cut off count in the mean."""
    entropies = torch.tensor([0.5, 0.5, 1.5, 1.5], requires_grad=True)
    value = trusted_mean(entropies, torch.ones(4, dtype=torch.bool), share)
    value.backward()
    assert value.item() == pytest.approx(expected, abs=1e-5)
    kept = 0.25 / LN
    torch.testing.assert_close(
        entropies.grad, torch.tensor([kept, kept, *([0.0, 0.0] if share == 1 else [kept, kept])])
    )


def test_unlabelled_pixels_are_in_no_mean():
    entropies = torch.tensor([0.5, 0.0, 0.5, 1.5, 0.0, 1.5])
    labelled = torch.tensor([True, False, True, True, False, True])
    assert float(trusted_mean(entropies, labelled, 1.0)) == pytest.approx(0.04508, abs=1e-5)


def test_the_loss_fades_what_is_of_the_wrong_class():
    """One pixel of class 1, two wide surfels of codes e0 (in front, opacity .5) and e1 (.9), logits five times F."""
    size = 1
    inputs = discs(size, [(0.5, 0.5)] * 2, 1e3, [0.5, 0.9], [1.0, 2.0])
    inputs.opacity_logits.requires_grad_()
    codes = torch.eye(2, dtype=torch.float64)
    settings = RasterSettings(near=0.01, far=100.0, geometry=False)
    drawn = draw_features(TorchRasterizer(), inputs, codes, camera(size), settings).flatten(0, 1)
    torch.testing.assert_close(drawn, torch.tensor([[0.5, 0.45]]).double(), atol=1e-5, rtol=0)
    each = code_entropy(lambda values: 5 * values, drawn, torch.tensor([1]), 2)
    trusted_mean(each, torch.tensor([True]), 0.0).backward()
    o = torch.tensor([0.5, 0.9]).double()
    assert inputs.opacity_logits.grad is not None
    found = inputs.opacity_logits.grad / (o * (1 - o))
    torch.testing.assert_close(found, torch.tensor([5.3407, -1.4054]).double() / LN, atol=1e-4, rtol=0)
    torch.testing.assert_close(found, torch.tensor([0.9631, -0.2534]).double(), atol=1e-4, rtol=0)


CORNERS = [[float(x), float(y), float(z)] for x in (0, 1) for y in (0, 1) for z in (0, 1)]


def hull(points: list, count: int) -> list[int]:
    """Return the indices of the points inside the hull of the first ``count``."""
    means = torch.tensor(points)
    return inside_hull(means, torch.arange(len(means)) < count).nonzero()[:, 0].tolist()


def test_a_hull_adds_what_lies_inside():
    others = [[0.5, 0.5, 0.5], [2.0, 2.0, 2.0]]
    assert hull([*CORNERS, *others], 8) == list(range(9))
    assert hull([*CORNERS[:4], *others], 4) == [], "all in a plane"
    assert hull([*CORNERS[:3], *others], 3) == [], "too few"
    tetrahedron = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    assert hull([*tetrahedron, [0.1, 0.1, 0.1], [0.9, 0.9, 0.9]], 4)[-1] == 4


def test_outliers_stay_where_no_four_would_be_left():
    """Each of six on the axes is an outlier along its own; a far one of nine is not in the hull of the others."""
    axes = [[sign * float(k == axis) for k in range(3)] for axis in range(3) for sign in (-1.0, 1.0)]
    assert 6 in hull([*axes, [0.1, 0.1, 0.1], [2.0, 0.0, 0.0]], 6) and 7 not in hull([*axes, [0.1] * 3, [2.0] * 3], 6)
    assert 9 not in hull([*CORNERS, [10.0, 0.0, 0.0], [4.0, 0.1, 0.1]], 9)


@pytest.mark.parametrize("broken", [math.nan, math.inf])
def test_broken_centres_have_no_part_in_a_hull(broken):
    assert hull([[broken, 0.0, 0.0], *CORNERS, [0.5, 0.5, 0.5], [2.0, 2.0, 2.0]], 9) == list(range(1, 10))
    assert hull([[broken] * 3, *CORNERS[:3], [0.1, 0.1, 0.1]], 4) == [], "three are too few"


def trained(steps: int = 0, **options) -> IlgsTraining:
    training = IlgsTraining(trained_scene(steps=max(steps, 1_000)), IlgsRefiner(**options))
    stepped(training, range(steps), geometry=True)
    return training


def test_the_masks_reach_codes_classifier_and_geometry():
    training = trained()
    found = training.terms(loss_inputs(training.scene), 0, lambda: {"photometric": torch.zeros(())})
    assert set(found) == {"photometric", "identities"}
    found["identities"].backward()
    surfels = training.scene.surfels()
    for name in ("means", "quats", "log_scales", "opacity_logits"):
        gradient = getattr(surfels, name).grad
        assert gradient.abs().max() > 1e-6 and not gradient[-1].any(), name
    assert surfels.sh_dc.grad is None or not surfels.sh_dc.grad.any()
    assert all(values.grad is not None and values.grad.any() for values in training.learned.parameters)
    assert training.learned.classifier.weight.shape == (256, 16)
    twice = IlgsTraining(training.scene, IlgsRefiner(weight=2.0)).terms(loss_inputs(training.scene), 0, dict)
    assert twice["identities"].item() == pytest.approx(2 * found["identities"].item())


def test_the_bound_follows_the_steps(monkeypatch):
    """It is the mean in the last step."""
    training, shares = trained(), []
    assert training.scene.steps == 1_000
    monkeypatch.setattr(ilgs, "trusted_mean", lambda each, labelled, share: shares.append(share) or each.sum())
    for step in (0, 499, 999):
        training.terms(loss_inputs(training.scene), step, dict)
    assert shares == [0.001, 0.5, 1.0]


def test_without_weight_or_mask_the_base_just_trains_on():
    """The very terms of the base, and nothing learned."""
    given = {"photometric": torch.ones(())}
    unmasked = trained()
    scene = unmasked.scene
    blank = replace(scene, labels=[torch.full_like(scene.labels[0], IGNORE)])
    assert trained(weight=0.0).terms(loss_inputs(scene), 0, lambda: given) == given
    assert unmasked.terms(loss_inputs(scene, masked=False), 0, lambda: given) == given
    assert unmasked.terms(loss_inputs(blank), 0, lambda: given) == given
    before = [values.detach().clone() for values in unmasked.learned.parameters]
    unmasked.before_step(0)
    unmasked.after_step(0)
    assert all(torch.equal(a, b) for a, b in zip(before, unmasked.learned.parameters, strict=True))


@pytest.mark.slow("trains codes until they know the masks")
def test_codes_learn_the_masks_and_leave_objects(capsys):
    training = trained(200, hull=False)
    found, scene = training.finish(), training.scene
    assert "labelled pixels of training views get their class" in capsys.readouterr().out
    assert found.objects is not None and sorted(found.objects) == list(FAR_APART[1:])
    for class_id in FAR_APART[1:]:
        own = scene.class_ids() == class_id
        assert found.of(class_id)[own].float().mean() > 0.6 > 0.1 > found.of(class_id)[~own].float().mean()
    sure = []
    for with_hull in (False, True):
        again = IlgsTraining(scene, IlgsRefiner(threshold=0.9, hull=with_hull))
        again.restore(training.state())
        sure.append(again.finish())
    for class_id in FAR_APART[1:]:
        assert not (sure[0].of(class_id) & ~sure[1].of(class_id)).any(), "a hull only adds"
    capsys.readouterr()
    nobody = IlgsTraining(scene, IlgsRefiner(threshold=0.999_999))
    assert not any(len(each) for each in (nobody.finish().objects or {}).values())
    assert "too few Gaussians or all lie in a plane: class_7, class_40000" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"threshold": -0.1}, "threshold is -0.1: give a probability"),
        ({"weight": -1.0}, "weight is -1: give the weight of a loss"),
        ({"weight": math.inf}, "weight is inf: give the weight of a loss"),
    ],
)
def test_mistakes(options, sentence):
    with pytest.raises(UserError, match=sentence):
        IlgsRefiner(**options)
