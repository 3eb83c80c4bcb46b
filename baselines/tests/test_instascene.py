"""InstaScene: the loss of prototypes and the choice of members by hand, and its training on the discs."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from trained_scenes import FAR_APART, crowded, stepped, trained_scene

from beags_baselines import mask_tracking
from beags_baselines import prototypes as parts
from beags_baselines.instascene import ContrastTraining, InstaSceneRefiner
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.preparation.refiner_training import TrainedScene
from beags_plugin.refiners import make_refiner
from beags_plugin.system.errors import UserError

FEW = {"min_gaussians": 5, "samples": 2_000}


def rows(*values: tuple[float, float]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float32, requires_grad=True)


def test_the_loss_of_prototypes():
    two, classes = rows((2, 0), (3, 0), (0, 1), (0, 9)), torch.tensor([4, 4, 7, 7])
    assert parts.prototype_loss(two, classes).item() == pytest.approx(0.507712, abs=2e-6)
    alike = rows((1, 0), (1, 0), (1, 0), (1, 0))
    assert parts.prototype_loss(alike, classes).item() == pytest.approx(2.772589, abs=2e-6)
    fixed = torch.zeros(8, 2)
    fixed[4, 0] = fixed[7, 1] = 1.0
    assert parts.prototype_loss(alike, classes, fixed).item() == pytest.approx(4 * 1.126928, abs=4e-6)
    assert parts.prototype_loss(two[:0], classes[:0]).item() == 0


def test_the_norm_has_no_gradient_and_prototypes_have_one():
    features = rows((2, 0), (0, 1))
    parts.prototype_loss(features, torch.tensor([0, 1])).backward()
    assert features.grad is not None and features.grad[0, 0] < 0, "longer features would cost less"
    several = rows((1, 0), (0.8, 0.6), (0, 1))
    parts.prototype_loss(several, torch.tensor([0, 0, 1])).backward()
    fixed = rows((1, 0), (0.8, 0.6), (0, 1))
    parts.prototype_loss(fixed, torch.tensor([0, 0, 1]), torch.tensor([[0.9, 0.3], [0, 1]])).backward()
    assert several.grad is not None and fixed.grad is not None and not torch.allclose(several.grad, fixed.grad)


def test_temperatures_of_loose_classes_are_higher():
    g = torch.tensor([(1.0, 0.0), (0.6, 0.8)])
    u, places, counts = torch.tensor([(0.8, 0.4)]), torch.zeros(2, dtype=torch.int64), torch.tensor([2.0])
    assert parts.temperatures(g, u, places, counts).item() == pytest.approx(0.6472, abs=1e-4)
    assert parts.temperatures(g, 9 * u, places, counts).item() == 1.0
    assert parts.temperatures(g[:1], g[:1], places[:1], counts / 2).item() == 0.5


def test_members_are_like_the_mean_of_seeds_which_is_short_if_they_are_loose():
    features = torch.tensor([(1.0, 0), (0.6, 0.8), (0.894, 0.447), (0, 1)]) * torch.tensor([[1.0], [2], [3], [0]])
    found, alike = parts.members(features, torch.tensor([0, 1]))
    assert found.tolist() == [True, True, False, False] and not alike, "nobody has 0.9: the seeds"
    found, alike = parts.members(features, torch.tensor([0, 1]), cosine=0.85)
    assert found.tolist() == [False, False, True, False] and alike
    assert parts.members(features, torch.tensor([0]), cosine=0.59)[0].tolist() == [True, True, True, False]
    assert not parts.members(features, torch.zeros(0, dtype=torch.int64))[0].any()


def test_orthonormal_prototypes():
    found = parts.orthonormal(16, torch.Generator().manual_seed(0))
    torch.testing.assert_close(found @ found.T, torch.eye(16), atol=1e-6, rtol=0)
    names = dict.fromkeys(range(17), "")
    InstaSceneRefiner().check(names)
    with pytest.raises(UserError, match="gram_feat has room for 16 classes, .* and there are 17"):
        InstaSceneRefiner(gram_feat=True).check(names)


def trained(scene: TrainedScene, steps: int, **options) -> ContrastTraining:
    training = ContrastTraining(scene, InstaSceneRefiner(**{**FEW, **options}))
    stepped(training, range(steps), drawn=False)
    return training


@pytest.mark.parametrize("options", [{}, {"gram_feat": True}, {"consider_negative": False}])
def test_objects_are_found_with_ids_far_apart(options, capsys):
    scene = trained_scene()
    before = scene.surfels().detach().clone()
    training = trained(scene, 150, **options)
    found = training.finish()
    assert "0 objects without seeds" in capsys.readouterr().out
    assert sorted(found.objects or {}) == list(FAR_APART[1:])
    for class_id in FAR_APART[1:]:
        own = scene.class_ids() == class_id
        inside, outside = (found.of(class_id)[each].float().mean() for each in (own, ~own))
        assert inside > 0.8 and outside < (0.3 if options else 0.1), (inside, outside)
    assert all(torch.equal(*pair) for pair in zip(vars(before).values(), vars(scene.surfels()).values(), strict=True))
    start = ContrastTraining(scene, InstaSceneRefiner())
    moved = (training.features.detach() - start.features.detach()).abs().amax(dim=1) > 0
    assert moved[:-1].sum() > 60 and not moved[-1], "the last one is seen by nobody"


def test_terms_and_their_turns():
    training = trained(trained_scene(), 0)
    training.before_step(0)
    found = {step: set(training.terms(None, step, dict)) for step in (0, 1, 9, 10)}  # pyright: ignore
    assert found == {0: {"single", "multi", "space"}, 1: {"single", "space"}, 9: {"single", "space"}, 10: found[0]}
    several = [training._several(10 * step) for step in range(30)]
    assert all(each == list(range(each[0], each[0] + 5)) for each in several)
    assert {each[0] for each in several} == {0, 1, 2, 3, 4}


def test_weights_and_the_rate(monkeypatch):
    monkeypatch.setattr(parts, "prototype_loss", lambda *_: torch.ones(()))
    for gram_feat in (False, True):
        training = trained(trained_scene(), 0, gram_feat=gram_feat)
        training.before_step(0)
        found = training.terms(None, 0, dict)  # pyright: ignore[reportArgumentType]
        expected = {"single": 0.5e-6, "multi": 1e-6, "space": 2.5e-6, **({"unfiltered": 1e-6} if gram_feat else {})}
        assert {name: value.item() for name, value in found.items()} == pytest.approx(expected)
        assert [(group["lr"], group["eps"]) for group in training.adam.param_groups] == [(0.025, 1e-15)]


def test_masks_that_are_left_out_are_background_in_the_term_of_their_view_alone(monkeypatch):
    training, asked, loss = trained(trained_scene(), 0, gram_feat=True), [], parts.prototype_loss

    def spied(features, classes, prototypes=None):
        asked.append(set(classes.tolist()))
        return loss(features, classes, prototypes)

    monkeypatch.setattr(parts, "prototype_loss", spied)
    training.before_step(0)
    assert training.tracked is not None
    every = frozenset((view, rank) for view in range(len(training.scene.cameras)) for rank in (1, 2))
    training.tracked = mask_tracking.TrackedMasks(training.tracked.seeds, every)
    names = list(training.terms(None, 0, dict))  # pyright: ignore[reportArgumentType]
    classes = dict(zip(names, asked, strict=True))
    assert classes["single"] == {0} and classes["unfiltered"] > {0}
    assert classes["multi"] == classes["space"] == {1, 2}


def test_what_options_change_in_the_terms(monkeypatch):
    """The classes that each term contrasts in several steps, and whether its prototypes are fixed."""
    asked, loss = [], parts.prototype_loss

    def spied(features, classes, prototypes=None):
        asked.append((set(classes.tolist()), prototypes is not None))
        return loss(features, classes, prototypes)

    monkeypatch.setattr(parts, "prototype_loss", spied)

    def terms(**options) -> tuple[ContrastTraining, dict[str, tuple[set[int], bool]]]:
        training, found = trained(trained_scene(), 0, **options), {}
        training.before_step(0)
        for step in range(0, 90, 10):
            asked.clear()
            names = list(training.terms(None, step, dict))  # pyright: ignore[reportArgumentType]
            for name, (classes, fixed) in zip(names, asked, strict=True):
                found[name] = (found.get(name, (set(),))[0] | classes, fixed)
        return training, found

    every, objects = {0, 1, 2}, {1, 2}
    plain, found = terms()
    assert found == {"single": (every, False), "multi": (objects, False), "space": (objects, False)}
    assert terms(consider_negative=False)[1] == {**found, "single": (objects, False)}
    training, found = terms(gram_feat=True)
    whole = {"single": (every, False), "unfiltered": (every, False)}
    assert found == {**whole, "multi": (objects, True), "space": (objects, True)}
    seeds = training.seed_classes.nonzero()[:, 0]
    assert training.fixed is not None and len(seeds) > 20
    assert torch.equal(training.features[seeds], training.fixed[training.seed_classes[seeds]])
    rest = training.seed_classes == 0
    assert torch.equal(training.features[rest], plain.features[rest])


def test_what_options_change_in_the_tracking(monkeypatch):
    asked, scene, tracked_masks = [], trained_scene(), mask_tracking.tracked_masks

    def spied(views, count, num_classes, min_gaussians, ground_votes, progress):
        asked.append((min_gaussians, ground_votes, sum(len(view.members) for view in views)))
        return tracked_masks(views, count, num_classes, min_gaussians, ground_votes, progress)

    monkeypatch.setattr(mask_tracking, "tracked_masks", spied)
    for options in ({}, {"ground_votes": True, "min_gaussians": 7}, {"min_weight": 0.1}, {"min_weight": 0.5}):
        trained(scene, 1, **options)
    traced = asked[0][2]
    assert asked[:3] == [(5, False, traced), (7, True, traced), (5, False, traced)]
    assert 0 < asked[3][2] < 0.8 * traced, "few weigh more than half at a pixel"


def test_few_views_and_views_without_masks():
    base = trained_scene()
    labels = [base.labels[0], torch.full_like(base.labels[1], IGNORE), base.labels[2]]
    training = trained(replace(base, cameras=base.cameras[:3], labels=labels), 12)
    assert training.masked == [0, 2] and training._several(0) == [0, 2]
    nothing = trained(replace(base, cameras=base.cameras[:2], labels=labels[1:2] * 2), 3)
    assert nothing.finish().present() == [0]


@pytest.mark.parametrize("options", [{}, {"gram_feat": True}])
@pytest.mark.parametrize("step", [0, 1, 10, 13])
def test_a_restored_training_goes_on_bit_for_bit(options, step, tmp_path):
    scene = trained_scene()
    whole, first = trained(scene, 22, **options), trained(scene, step, **options)
    torch.save(first.state(), tmp_path / "state.pt")
    second = trained(scene, 0, **options)
    second.restore(torch.load(tmp_path / "state.pt", weights_only=True))
    stepped(second, range(step, 22), drawn=False)
    assert torch.equal(whole.features, second.features) and whole.tracked is not None
    assert second.tracked is not None and whole.tracked.suspect == second.tracked.suspect
    assert all(torch.equal(*pair) for pair in zip(whole.tracked.seeds, second.tracked.seeds, strict=True))


def test_threads_change_nothing(for_threads):
    scene = crowded(trained_scene())

    def run() -> list[torch.Tensor]:
        training = trained(scene, 12, samples=32_768)
        return [training.features.detach(), training.seed_classes, training.finish().class_ids]

    assert all(torch.equal(first, each) for first, *rest in zip(*for_threads(run), strict=True) for each in rest)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"cosine": 1.2}, "cosine is 1.2: give one above 0, up to 1"),
        ({"min_gaussians": 0}, "min_gaussians is 0: give a number, 1 or more"),
        ({"samples": 0}, "samples is 0"),
        ({"min_weight": 1.0}, "min_weight is 1: give a blending weight, from 0 to below 1"),
    ],
)
def test_options_that_cannot_work(options, sentence):
    with pytest.raises(UserError, match=sentence):
        make_refiner("instascene", options)
