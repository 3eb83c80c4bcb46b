"""Dr. Splat: three layers over three pixels, ties and unseen Gaussians, and assignment as its limit."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from owned_scenes import OwnedScene
from raster_scenes import facing
from run_folders import CLASSES

from beags_baselines.dr_splat import DrSplatRefiner, margins
from beags_plugin.assignment.contributions import Contributions, contributions
from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.preparation.refiner import AssignedScene
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.refiners import make_refiner
from beags_plugin.system.errors import UserError

SETTINGS = RasterSettings(near=0.1, far=100.0, geometry=False)


def layers(rasterizer, labels: list[int], **options) -> Membership:
    """The objects of three wide layers, whose weights are 0.05, 0.76 and 0.095, in views of one labelled pixel each."""
    inputs, camera = facing(1, 1, [(0.5, 0.5, 1e4, opacity) for opacity in (0.05, 0.8, 0.5)])
    what = (inputs.means, inputs.quats, inputs.log_scales, inputs.opacity_logits)
    surfels = Surfels.of(*what, torch.zeros(3, 1, 3, dtype=torch.float64))
    views = [torch.tensor([[label]], dtype=torch.int32) for label in labels]
    seen = (surfels, [camera] * len(labels), views, rasterizer, SETTINGS, 3)
    shares = contributions(*seen)
    class_ids = shares.largest()[0]
    scene = AssignedScene(surfels, class_ids, *seen[1:3], 3, [1, 2], rasterizer, SETTINGS, 0, shares)
    return DrSplatRefiner(**options).members(scene)


def listed(members: Membership) -> list[list[int]]:
    return [members.of(class_id).nonzero()[:, 0].tolist() for class_id in (1, 2)]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"top_k": 2}, [[1, 2], []]),  # the nearest, 0, is the weakest: no first-come choice
        ({"top_k": 3}, [[0, 1, 2], []]),
        ({"top_k": 3, "negatives": "zero"}, [[0, 1, 2], [0, 1, 2]]),
        ({"top_k": 2, "within": 2}, [[0, 1], []]),
        ({"threshold": 0.989}, [[], []]),  # r(1) is 0.98871
        ({"threshold": 0.988}, [[0, 1, 2], []]),
    ],
)
def test_three_layers(rasterizer, options, expected):
    assert listed(layers(rasterizer, [1, 1, 2], **options)) == expected


def test_a_tie_is_of_no_class(rasterizer):
    assert listed(layers(rasterizer, [1, 2])) == [[], []], "assignment gives the lower id"
    assert listed(layers(rasterizer, [1, 2], negatives="zero")) == [[0, 1, 2], [0, 1, 2]]


def test_activations():
    keys, sums = torch.tensor([4, 5, 6, 12, 13]), torch.tensor([2.0, 1.0, 0.0, 3.0, 3.0]).double()
    table = Contributions(4, 4, keys[sums > 0], sums[sums > 0])
    activations = torch.sigmoid(10 * margins(table))
    assert activations.tolist() == pytest.approx([0.98871, 0.01129, 0.5, 0.5], abs=1e-5)
    alone = torch.sigmoid(10 * margins(Contributions(1, 4, keys[:1] - 4, sums[:1])))
    assert alone.tolist() == pytest.approx([1 / (1 + math.exp(-10))])


@pytest.mark.parametrize("far", [False, True])
def test_with_all_of_a_ray_it_is_assignment_without_the_unseen(far, capsys):
    """Ids may lie far apart; one Gaussian is seen by nobody and belongs to nothing."""
    ids = torch.tensor([0, 300, 40_000] if far else [0, 1, 2], dtype=torch.int32)
    held = OwnedScene()
    hidden = held.surfels[:1].clone()
    hidden.means[:] = torch.tensor([[0.0, 0.0, -50.0]])
    pairs = zip(vars(held.surfels).values(), vars(hidden).values(), strict=True)
    surfels = Surfels(*(torch.cat(pair) for pair in pairs))
    ranked, count = list(held.labels), len(CLASSES)
    shares = contributions(surfels, held.cameras, ranked, held.scene.rasterizer, held.scene.settings, count)
    shares = replace(shares, classes=ClassRanks(ids))
    class_ids, top, total = shares.largest()
    labels = [ids[each.long()] for each in ranked]
    numbered = (int(ids.max()) + 1, ids[1:].tolist(), held.scene.rasterizer, held.scene.settings, 0, shares)
    scene = AssignedScene(surfels, class_ids, held.cameras, labels, *numbered)
    found = DrSplatRefiner(top_k=1000, within=1000).members(scene)
    assert "0.00% of the weight lies beyond" in capsys.readouterr().out
    tied = (total > 0) & (2 * top <= total * (1 + 1e-9))
    assert len(class_ids) > 70 and int(tied.sum()) < 5 and total[-1] == 0
    assert torch.equal(found.class_ids[~tied], class_ids.masked_fill(total == 0, 0)[~tied])
    DrSplatRefiner(top_k=1).members(scene)
    assert "0.00% of" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"top_k": 0}, "top_k is 0: give a number of Gaussians, 1 or more"),
        ({"within": -1}, "within is -1"),
        ({"negatives": "other"}, "did you mean others"),
        ({"threshold": 0.4}, "threshold is 0.4: give an activation, from 0.5 to below 1"),
        ({"threshold": 1.0}, "threshold is 1:"),
    ],
)
def test_options_that_cannot_work(options, sentence):
    with pytest.raises(UserError, match=sentence):
        make_refiner("dr-splat", options)
