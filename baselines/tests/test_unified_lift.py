"""Unified-Lift's training: what its terms reach, the codes that classes get, and the objects it leaves."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from drawn_discs import camera, discs
from trained_scenes import FAR_APART, loss_inputs, stepped, trained_scene

from beags_baselines import object_codebook
from beags_baselines.unified_lift import CodebookTraining, UnifiedLiftRefiner
from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.preparation.refiner_training import TrainedScene
from beags_plugin.system.errors import UserError


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(object_codebook, "SAMPLES", 2_000)


def trained(steps: int = 0, scene: TrainedScene | None = None, **options) -> CodebookTraining:
    training = CodebookTraining(scene or trained_scene(), UnifiedLiftRefiner(**options))
    stepped(training, range(steps))
    return training


def gradients(training: CodebookTraining, name: str) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    """Return the gradients that one term gives to the codes and to the codebook; the scene gets none."""
    terms = training.terms(loss_inputs(training.scene, 2), 2, dict)
    found = torch.autograd.grad(
        terms[name], [*training.learned.parameters, *vars(training.scene.surfels()).values()], allow_unused=True
    )
    assert all(values is None for values in found[2:]), "the scene gets nothing at all"
    return found[0], found[1]


@pytest.mark.parametrize("name", ["contrast", "norms"])
def test_pixels_reach_the_codes_alone(name):
    of_codes, of_codebook = gradients(trained(), name)
    assert of_codebook is None and of_codes is not None
    assert of_codes.any(dim=1)[:-1].sum() > 60 and not of_codes[-1].any(), "the last one is seen by nobody"


@pytest.mark.parametrize("name", ["classes", "concentration"])
def test_matched_pixels_reach_the_codebook_alone(name):
    of_codes, of_codebook = gradients(trained(), name)
    assert of_codes is None and of_codebook is not None
    assert int(of_codebook.any(dim=1).sum()) == (256 if name == "classes" else 3)


def test_weights_and_rates(monkeypatch):
    training = trained()
    found = training.terms(loss_inputs(training.scene), 0, lambda: pytest.fail("nothing of the scene is trained"))
    monkeypatch.setattr(object_codebook, "WEIGHTS", dict.fromkeys(object_codebook.WEIGHTS, 1.0))
    plain = training.terms(loss_inputs(training.scene), 0, dict)
    weights = {name: float(value.detach() / plain[name].detach()) for name, value in found.items()}
    expected = {"contrast": 1e-6, "norms": 1e-6, "classes": 1e-4, "concentration": 1.0}
    assert weights == pytest.approx(expected, rel=1e-4)
    drawn = training.learned.rendered(training.scene.surfels().detach(), training.scene.cameras[0]).flatten(0, 1)
    every = torch.ones(len(drawn), dtype=torch.bool)
    assert float(object_codebook.norms(drawn, every).detach()) == pytest.approx(float(plain["norms"].detach()))
    assert [(group["lr"], group["eps"]) for group in training.learned.adam.param_groups] == [
        (pytest.approx(0.025), 1e-15),
        (pytest.approx(0.005), 1e-8),
    ]
    longer = CodebookTraining(trained_scene(steps=30_000), UnifiedLiftRefiner())
    assert [group["lr"] for group in longer.learned.adam.param_groups] == [0.0025, 0.0005]
    assert training.learned.codes.abs().max() < 1.773 and training.learned.classifier.weight.abs().max() < 0.25


def test_a_view_that_is_right_has_no_term_of_classes():
    """Each Gaussian has the code of its class, so the largest code of a pixel is that of its mask."""
    training = trained()
    ranks = training.ranks.ranks(training.scene.class_ids()).long()
    with torch.no_grad():
        training.learned.codes.copy_(3 * torch.eye(16)[ranks])
        training.learned.classifier.weight.zero_()[:3, :3] = 5 * torch.eye(3)
    assert set(training.terms(loss_inputs(training.scene), 0, dict)) == {"contrast", "norms", "concentration"}
    other = replace(training.scene, labels=[training.scene.labels[0].clone()])
    other.labels[0][0, 0] = 7  # a stray pixel
    assert "classes" in training.terms(loss_inputs(other), 0, dict)


def test_pixels_that_are_not_reliable_teach_no_code(monkeypatch):
    """Only reliable pixels count in the terms of the codebook; all count in those of codes."""
    training, counted = trained(), torch.zeros(0, dtype=torch.bool)

    def terms(chosen: slice) -> dict[str, float]:
        def some(drawn, group, count):
            nonlocal counted
            counted = torch.zeros(len(drawn), dtype=torch.bool)
            counted[chosen] = True
            return counted

        monkeypatch.setattr(object_codebook, "reliable", some)
        found = training.terms(loss_inputs(training.scene), 0, dict)
        return {name: value.item() for name, value in found.items()}

    nothing, half, every = terms(slice(0, 0)), terms(slice(0, None, 2)), terms(slice(0, None))
    assert set(nothing) == {"contrast", "norms"} and int(counted.sum()) == len(counted) > 100
    for name in ("contrast", "norms"):
        assert nothing[name] == half[name] == every[name]
    asked, selection = [], object_codebook.selection
    monkeypatch.setattr(object_codebook, "selection", lambda *what: asked.append(len(what[1])) or selection(*what))
    assert terms(slice(0, None, 2)) == half and asked == [(len(counted) + 1) // 2]
    assert half["concentration"] != every["concentration"]


def test_a_step_without_mask_leaves_all_as_it_is():
    training = trained(3)
    before = [values.detach().clone() for values in training.learned.parameters]
    stepped(training, range(3, 6), masked=False)
    blank = replace(training.scene, labels=[torch.full_like(each, IGNORE) for each in training.scene.labels])
    training.scene = blank
    stepped(training, range(6, 9))
    assert all(torch.equal(values, old) for values, old in zip(training.learned.parameters, before, strict=True))


def test_unlabelled_pixels_enter_no_term():
    """Anything may lie under them."""
    scene = trained_scene()
    hidden = torch.zeros_like(scene.labels[0], dtype=torch.bool)
    hidden[:, ::3] = True
    given = loss_inputs(replace(scene, labels=[scene.labels[0].masked_fill(hidden, IGNORE)]))
    one, other = trained(scene=scene), trained(scene=scene)
    found = one.terms(given, 0, dict)
    weights = hidden[..., None].expand(-1, -1, 16).flatten(0, 1)
    drawn = other.learned.rendered

    def disturbed(surfels, camera):
        return torch.where(weights.view(*hidden.shape, 16), 9.0, drawn(surfels, camera))

    other.learned.rendered = disturbed  # pyright: ignore[reportAttributeAccessIssue]
    again = other.terms(given, 0, dict)
    assert {name: value.item() for name, value in found.items()} == {n: v.item() for n, v in again.items()}


def test_codes_learn_the_masks_and_leave_the_base(capsys):
    scene = trained_scene()
    base = scene.surfels().clone()
    training = trained(150, scene, hull=False)
    found = training.finish()
    assert "of them belong to one class\n" in capsys.readouterr().out, "every class has a code"
    assert all(torch.equal(getattr(scene.surfels(), name), values) for name, values in vars(base).items())
    assert found.objects is not None and sorted(found.objects) == list(FAR_APART[1:])
    by_argmax = CodebookTraining(scene, UnifiedLiftRefiner(rule="argmax"))
    by_argmax.restore(training.state())
    exclusive = by_argmax.finish()
    assert exclusive.objects is None and exclusive.class_ids.dtype == torch.int32
    sure = []
    for hull in (False, True):
        again = CodebookTraining(scene, UnifiedLiftRefiner(threshold=0.9, hull=hull))
        again.restore(training.state())
        sure.append(again.finish())
    for class_id in FAR_APART[1:]:
        own = scene.class_ids() == class_id
        for each in (found, exclusive):
            assert each.of(class_id)[own].float().mean() > 0.8 > 0.3 > each.of(class_id)[~own].float().mean()
        assert not (sure[0].of(class_id) & ~sure[1].of(class_id)).any(), "a hull only adds"
    few, more = (sum(int(each.of(c).sum()) for c in FAR_APART[1:]) for each in sure)
    assert 0 < few < more


def test_classes_without_a_code_are_named(capsys):
    training = trained()
    with torch.no_grad():
        training.learned.codes.zero_()  # every pixel gets the same code
    found = training.finish()
    out = " ".join(capsys.readouterr().out.split())
    assert "1 codes are used" in out and "class_7, class_40000: train longer (refine_steps)" in out
    assert found.objects is not None and not any(len(each) for each in found.objects.values())


def test_a_restored_run_goes_on_alike():
    whole, scene = trained(8), trained_scene()
    first = trained(5, scene)
    again = CodebookTraining(scene, UnifiedLiftRefiner())
    again.restore(first.state())
    stepped(again, range(5, 8))
    assert all(torch.equal(a, b) for a, b in zip(whole.learned.parameters, again.learned.parameters, strict=True))


def test_two_opaque_dots_in_front_of_a_wall():
    """Each dot has a mask and becomes an object; the wall has none and becomes none."""
    size, wide = 9, 1e3
    inputs = discs(size, [(2.5, 4.5), (6.5, 4.5), (4.5, 4.5)], 0.4, [0.95, 0.95, 0.95], [1.0, 1.0, 2.0])
    inputs.log_scales[2] = torch.tensor(wide).log()
    rest = torch.zeros(3, 0, 3)
    surfels = Surfels(
        *(vars(inputs)[n].float() for n in ("means", "quats", "log_scales", "opacity_logits", "colors")), rest
    )
    view = camera(size)
    view = Camera(view.viewmat.float(), view.K.float(), size, size)
    labels = torch.zeros(size, size, dtype=torch.int32)
    labels[4, 2], labels[4, 6] = 1, 2
    scene = replace(
        trained_scene((0, 1, 2)),
        surfels=lambda: surfels,
        class_ids=lambda: torch.tensor([1, 2, 0], dtype=torch.int32),
        cameras=[view] * 2,
        labels=[labels] * 2,
    )
    training = trained(200, scene, rule="argmax")
    found = training.finish()
    assert found.class_ids.tolist() == [1, 2, 0]


MISTAKES = {
    "rule is unknown": ({"rule": "mean"}, "no rule of objects 'mean'"),
    "threshold": ({"threshold": 1.0}, "threshold is 1: give a probability"),
    "codes": ({"codes": 1}, "codes is 1: give a number of codes"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes(mistake):
    options, sentence = MISTAKES[mistake]
    with pytest.raises(UserError, match=sentence):
        UnifiedLiftRefiner(**options)


def test_too_few_codes_for_the_classes():
    refiner = UnifiedLiftRefiner(codes=3)
    refiner.check({0: "background", 1: "cup", 9: "box"})
    with pytest.raises(UserError, match="codes is 3, but there are 4 classes: give as many codes at least"):
        refiner.check({0: "background", 1: "cup", 9: "box", 11: "cap"})
