"""OpenGaussian's training: its stages, what they leave alone, and the objects of scenes made by hand."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from raster_scenes import facing
from trained_scenes import FAR_APART, crowded, loss_inputs, stepped, trained_scene

from beags_baselines import instance_features as parts
from beags_baselines.opengaussian import CodebookTraining, OpenGaussianRefiner
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.preparation.refiner_training import TrainedScene
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.refiners import make_refiner
from beags_plugin.system.errors import UserError

NO_LIMITS = {"min_gaussians": 1, "min_leaf": 1, "max_scale": float("inf")}


def dots(steps: int, unlabelled: bool = False) -> TrainedScene:
    """Four opaque dots, two of each of the ids 1 and 2, in a row of pixels, seen alike by three cameras."""
    places = [(4 * i + 2.5, 0.5, 1e-3, 0.99) for i in range(4)]
    inputs, camera = facing(17, 1, places, torch.float32)
    what = (inputs.means, inputs.quats, inputs.log_scales, inputs.opacity_logits)
    surfels = Surfels.of(*what, torch.zeros(4, 1, 3))
    labels = torch.zeros(1, 17, dtype=torch.int32)
    labels[0, [2, 6]], labels[0, [10, 14]] = 1, 2
    maps = [labels, labels, labels, torch.full_like(labels, IGNORE)]
    rasterizer, settings = make_rasterizer("auto"), RasterSettings(0.1, 100.0, geometry=False)
    return TrainedScene(
        lambda: surfels, lambda: torch.zeros(4, dtype=torch.int32), [camera] * 4, maps[3:] * 4 if unlabelled else maps,
        {0: "background", 1: "one", 2: "two"}, rasterizer, settings, 0, steps, 0, 1.0, 1.0,
        lambda title: nullcontext(lambda done, total: None),
    )  # fmt: skip


def solid_scene(steps: int) -> TrainedScene:
    """The discs, with masks of what is opaque."""
    scene = trained_scene(steps=steps)
    alphas = [loss_inputs(scene, view).render.alpha for view in range(len(scene.cameras))]
    pairs = zip(scene.labels, alphas, strict=True)
    return replace(scene, labels=[labels.where(alpha > 0.5, torch.zeros_like(labels)) for labels, alpha in pairs])


def trained(scene: TrainedScene, **options) -> CodebookTraining:
    training = CodebookTraining(scene, OpenGaussianRefiner(**options))
    stepped(training, range(scene.steps), drawn=False)
    return training


def test_dots_of_an_id_come_together_and_get_it(capsys):
    scene = dots(2_000)
    before = scene.surfels().clone()
    training = trained(scene, coarse=2, fine=2, **NO_LIMITS)
    found = training.finish()
    alike = torch.nn.functional.normalize(training.features.detach(), dim=1)
    cosines = alike @ alike.T
    assert min(cosines[0, 1], cosines[2, 3]) > 0.95 and cosines[:2, 2:].max() < 0.7
    assert found.class_ids.tolist() == [1, 1, 2, 2] and found.objects is None
    assert "resemble a mask in 2 views or more; they hold 100%" in capsys.readouterr().out
    assert all(torch.equal(*pair) for pair in zip(vars(before).values(), vars(scene.surfels()).values(), strict=True))


def test_stages_follow_the_shares_of_the_source():
    scene = trained_scene(steps=40_000)
    full = CodebookTraining(scene, OpenGaussianRefiner())
    assert full.starts == (0, 10_000, 20_000)
    assert (full.turn_steps, full.coarse_interval, full.fine_interval) == (300, 200, 50)
    short = CodebookTraining(replace(scene, steps=400), OpenGaussianRefiner())
    assert (short.starts, short.turn_steps) == ((0, 100, 200), 3)
    assert (short.coarse_interval, short.fine_interval) == (2, 1)
    rates = []
    for training in (full, short):
        for step in (0, training.starts[1], training.starts[2] - 1):
            training.stage(step)
            training.adam.param_groups[0]["lr"] = 0.0
            training.starts = (0, training.scene.steps // 4, training.scene.steps)  # makes no leaves
            training.before_step(step)
            rates.append(training.adam.param_groups[0]["lr"])
            training.starts = (0, training.scene.steps // 4, training.scene.steps // 2)
    assert rates == pytest.approx([1e-3, 1e-4, 1e-4, 1e-2, 1e-3, 1e-3])
    assert [short.stage(step) for step in (99, 100, 199, 200)] == [0, 1, 1, 2]
    assert short._turn(200) == (0, 0) and short._turn(205) == (2, 1) and short._turn(200 + 64 * 3) == (0, 0)


def test_terms_of_the_stages(monkeypatch):
    """Cohesion has a weight, and separation drops its lighter pairs in the second half of the first stage."""
    scene, late = replace(trained_scene(steps=32), labels=solid_scene(32).labels), []
    separation = parts.separation
    monkeypatch.setattr(parts, "separation", lambda means, now: late.append(now) or separation(means, now))

    def terms(step: int, **options) -> dict[str, float]:
        training = CodebookTraining(scene, OpenGaussianRefiner(coarse=2, fine=2, **NO_LIMITS, **options))
        training.before_step(step)
        found = training.terms(None, step, dict)  # pyright: ignore[reportArgumentType]
        return {name: value.item() for name, value in found.items()}

    one, two = terms(0), terms(0, cohesion_weight=0.2)
    assert set(one) == {"cohesion", "separation"} and one["separation"] == two["separation"]
    assert two["cohesion"] == pytest.approx(2 * one["cohesion"]) and one["cohesion"] > 0
    late.clear()
    for step in range(8):
        terms(step)
    assert late == [False] * 4 + [True] * 4
    assert set(terms(8)) == {"clusters"}


def test_lengths_are_those_of_the_input_poses(monkeypatch):
    """Positions beside features, and the size of Gaussians by which a cluster shows."""
    monkeypatch.setattr(parts, "fine_clusters", lambda *_: 1)
    for scale in (1.0, 4.0):
        scene = replace(solid_scene(8), scale=scale)
        largest = float(scene.surfels().log_scales.exp().max())
        training = CodebookTraining(scene, OpenGaussianRefiner(coarse=1, min_gaussians=1, max_scale=largest / 2))
        positions = training._vectors()[:, parts.CHANNELS :]
        torch.testing.assert_close(positions, 0.5 / scale * scene.surfels().means.detach())
        training._begin_leaves(scene.generator(0))
        assert bool(training.book.occurs.any()) is (scale > 1.0)


def test_a_cluster_gets_one_leaf_more_than_masks_that_it_shows(monkeypatch):
    for shown, used in ((0, 2), (1, 2), (3, 4), (7, 5)):
        monkeypatch.setattr(parts, "fine_clusters", lambda *_, shown=shown: shown)
        training = CodebookTraining(dots(8), OpenGaussianRefiner(coarse=1, fine=5, **NO_LIMITS))
        training._begin_leaves(training.scene.generator(0))
        assert training.book.used.tolist() == [used]
        assert bool(training.book.occurs[:3].all()) is bool(training.book.occurs.any()) is (shown > 0)


def test_a_cluster_that_hardly_shows_takes_no_step(monkeypatch):
    """Shrunk, or seen from afar, its largest alpha may be 0.8 or less."""
    scene = dots(64)
    training = CodebookTraining(scene, OpenGaussianRefiner(coarse=1, fine=2, **NO_LIMITS))
    stepped(training, range(33), drawn=False)
    training.book.occurs[:] = True
    draw, found = training.drawing.draw, []
    for factor in (0.79, 0.82):  # factors of alpha 0.99

        def fainter(*what, factor=factor):
            drawn, alpha = draw(*what)
            return drawn, factor / alpha.max() * alpha

        monkeypatch.setattr(training.drawing, "draw", fainter)
        found.append(set(training.terms(None, 40, dict)))  # pyright: ignore[reportArgumentType]
    assert found == [set(), {"leaves"}]


def test_sizes_shrink_in_half_of_the_steps():
    training = CodebookTraining(dots(8), OpenGaussianRefiner())
    sizes = torch.tensor([training._size(step) for step in range(2_000)])
    assert 0.45 < (sizes < 1).float().mean() < 0.55 and sizes.min() >= 1e-3
    assert sizes[sizes < 1].mean() == pytest.approx(0.5, abs=0.05)


def test_views_come_in_rounds_without_those_that_have_no_mask():
    training = CodebookTraining(dots(8), OpenGaussianRefiner())
    rounds = [[training.view_of(3 * number + place) for place in range(3)] for number in range(9)]
    assert all(sorted(each) == [0, 1, 2] for each in rounds) and len({tuple(each) for each in rounds}) > 2
    nothing = CodebookTraining(dots(8, unlabelled=True), OpenGaussianRefiner())
    stepped(nothing, range(8), drawn=False)
    assert nothing.finish().present() == [0]


@pytest.mark.parametrize("step", [3, 8, 9, 16, 17, 25])
def test_a_restored_training_goes_on_bit_for_bit(step, tmp_path):
    scene, options = trained_scene(steps=32), {"coarse": 5, "fine": 3, **NO_LIMITS}
    whole = trained(scene, **options)
    first = CodebookTraining(scene, OpenGaussianRefiner(**options))
    stepped(first, range(step), drawn=False)
    torch.save(first.state(), tmp_path / "state.pt")
    second = CodebookTraining(scene, OpenGaussianRefiner(**options))
    second.restore(torch.load(tmp_path / "state.pt", weights_only=True))
    stepped(second, range(step, 32), drawn=False)
    assert torch.equal(whole.features, second.features)
    for name, values in vars(whole.book).items():
        assert torch.equal(values, vars(second.book)[name]), name


def test_threads_change_nothing(for_threads):
    scene = crowded(trained_scene(steps=24))

    def run() -> list[torch.Tensor]:
        training = trained(scene, coarse=6, fine=3, **NO_LIMITS)
        return [training.features.detach(), *vars(training.book).values(), training.finish().class_ids]

    assert all(torch.equal(first, each) for first, *rest in zip(*for_threads(run), strict=True) for each in rest)


@pytest.mark.parametrize("rule", ["classes", "query"])
def test_objects_are_found_with_ids_far_apart(rule):
    scene = replace(solid_scene(1_200), scale=2.0)  # the discs are small, in units of the input poses
    training = trained(scene, coarse=6, fine=3, rule=rule, **NO_LIMITS)
    found = training.finish()
    assert set(found.present()) <= set(FAR_APART) and (found.objects is None) == (rule == "classes")
    for class_id in FAR_APART[1:]:
        own = scene.class_ids() == class_id
        inside, outside = (found.of(class_id)[each].float().mean() for each in (own, ~own))
        assert inside > (0.6 if rule == "classes" else 0.2) and outside < 0.4, (inside, outside)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"rule": "class"}, "did you mean classes"),
        ({"coarse": 0}, "coarse is 0: give a number, 1 or more"),
        ({"min_leaf": 0}, "min_leaf is 0"),
        ({"position_weight": -1.0}, "position_weight is -1: give a weight, 0 or more"),
        ({"max_scale": 0.0}, "max_scale is 0: give a length above 0"),
    ],
)
def test_options_that_cannot_work(options, sentence):
    with pytest.raises(UserError, match=sentence):
        make_refiner("opengaussian", options)
