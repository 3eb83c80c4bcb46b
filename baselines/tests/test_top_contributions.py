"""The largest weights of each pixel by class: counted by hand, and by sorting the weights that images show."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from raster_scenes import CLASSES, SCENES, facing
from torch import Tensor

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import draw_features

SETTINGS = RasterSettings(near=0.1, far=100.0, geometry=False)
WIDE = 1e4  # pixels
LAYERS = (0.05, 0.8, 0.5, 0.5)  # weights 0.05, 0.76, 0.095, 0.0475


def table(rasterizer, inputs, camera, settings, labels, num_classes, most, within) -> Tensor:
    what = (inputs, camera, settings, labels, num_classes, most, within)
    keys, sums = rasterizer.sparse_top_contributions(*what)
    assert bool((keys.diff() > 0).all()) and bool((sums > 0).all())
    found = sums.new_zeros(len(inputs.means) * num_classes)
    found[keys] = sums
    return found.view(-1, num_classes)


@pytest.mark.parametrize(
    ("most", "within", "expected"),
    [
        (1, 100, [0, 0.76, 0, 0]),
        (2, 100, [0, 0.76, 0.095, 0]),
        (3, 100, [0.05, 0.76, 0.095, 0]),  # the first has more than the last
        (9, 100, [0.05, 0.76, 0.095, 0.0475]),
        (1, 1, [0.05, 0, 0, 0]),
        (2, 3, [0, 0.76, 0.095, 0]),
        (9, 2, [0.05, 0.76, 0, 0]),
    ],
)
def test_the_largest_of_the_first_are_summed(rasterizer, most, within, expected):
    labels = torch.tensor([[1, 1, 0, IGNORE, -1, 3]], dtype=torch.int32)
    inputs, camera = facing(6, 1, [(0.5, 0.5, WIDE, opacity) for opacity in LAYERS])
    found = table(rasterizer, inputs, camera, SETTINGS, labels, 3, most, within)
    assert found[:, 1].tolist() == pytest.approx([2 * w for w in expected], rel=1e-6, abs=1e-12)
    assert found[:, 0].tolist() == pytest.approx(expected, rel=1e-6, abs=1e-12)
    assert not found[:, 2].any(), "ids of no class do not count"


def test_of_equal_weights_the_nearer_counts(rasterizer):
    inputs, camera = facing(1, 1, [(0.5, 0.5, WIDE, 0.5), (0.5, 0.5, WIDE, 1.0), (0.5, 0.5, WIDE, 0.5)])
    logits = torch.tensor([0.0, 40.0, 0.0], dtype=torch.float64)
    labels = torch.zeros(1, 1, dtype=torch.int32)
    half = replace(inputs, opacity_logits=logits[[0, 0, 0]], log_scales=inputs.log_scales)
    found = table(rasterizer, half, camera, SETTINGS, labels, 1, 1, 100)
    assert (found[:, 0] > 0).tolist() == [True, False, False]


@cache
def sorted_weights(backend: type, name: str) -> tuple[Tensor, Tensor]:
    """Return the weights [H, W, N] of all surfels at all pixels, the nearest first, and that order [N]."""
    scene = SCENES[name]()
    depths = (scene.inputs.means @ scene.camera.viewmat[:3, :3].T)[:, 2]
    order = depths.argsort(stable=True)
    one_hot = torch.eye(len(depths), dtype=torch.float64)
    return draw_features(backend(), scene.inputs, one_hot, scene.camera, scene.settings)[..., order], order


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize(("most", "within"), [(1, 100), (3, 100), (4, 9), (100, 100)])
def test_scenes_are_those_of_sorted_weights(rasterizer, name, most, within):
    """The weights of all surfels at all pixels are the image of one-hot features."""
    scene = SCENES[name]()
    inputs, count = scene.inputs, len(scene.inputs.means)
    expected = torch.zeros(count, CLASSES, dtype=torch.float64)
    if count:
        by_depth, order = sorted_weights(type(rasterizer), name)
        first = by_depth.where((by_depth > 0).cumsum(-1) <= within, torch.zeros_like(by_depth))
        values, places = first.topk(min(most, count), dim=-1)
        for class_id in range(CLASSES):
            own = scene.target == class_id
            expected[:, class_id].index_add_(0, order[places[own].flatten()], values[own].flatten())
    found = table(rasterizer, inputs, scene.camera, scene.settings, scene.target, CLASSES, most, within)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-8)
    if most >= count:
        whole = rasterizer.class_contributions(inputs, scene.camera, scene.settings, scene.target, CLASSES)
        torch.testing.assert_close(found, whole, rtol=1e-6, atol=1e-8)
