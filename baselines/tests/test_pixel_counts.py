"""Pixel counts of surfels by class, in cases that are counted by hand."""

from __future__ import annotations

import pytest
import torch
from raster_scenes import facing

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers.interface import RasterSettings

SETTINGS = RasterSettings(near=0.1, far=100.0, geometry=False)


def counts(rasterizer, inputs, camera, labels, num_classes, min_weight=0.0, settings=SETTINGS):
    """The table [N, num_classes] that the list stands for."""
    keys, values = rasterizer.sparse_class_pixel_counts(inputs, camera, settings, labels, num_classes, min_weight)
    assert keys.dtype == torch.int64 and values.dtype == torch.int32
    assert bool((keys.diff() > 0).all()) and bool((values > 0).all())
    table = torch.zeros(len(inputs.means) * num_classes, dtype=torch.int32)
    table[keys] = values
    return table.view(-1, num_classes)


WIDE = 1e4  # pixels: a surfel of one opacity over the whole image
HALVES = (torch.arange(64) >= 32).int().repeat(64, 1)  # class 1 from column 32 on
EVERYWHERE = torch.ones(5, 6, dtype=torch.int32)
CASES = {  # surfels, labels, least weight: counts by class, and sums of weights where they are told apart
    "one at a border": ([(32, 32, 4, 0.8)], HALVES, 0.0, [[270, 270]], None),
    "one near a border": ([(36, 32, 4, 0.8)], HALVES, 0.0, [[166, 374]], None),
    "one further off": ([(38, 32, 4, 0.8)], HALVES, 0.0, [[118, 422]], None),
    "one inside": ([(46, 32, 4, 0.8)], HALVES, 0.0, [[0, 540]], None),
    "one behind the camera": ([(46, 32, -4, 0.8)], HALVES, 0.0, [[0, 0]], None),
    # The same number of pixels counts at a hundredth of the weight.
    "one behind an opaque layer": (
        [(32, 32, WIDE, 0.999), (32, 32, 4, 0.8)], HALVES, 0.0, [[2048, 2048], [270, 270]], None,
    ),
    "two layers": ([(3, 2, WIDE, 0.9)] * 2, EVERYWHERE, 0.0, [[0, 30], [0, 30]], [27.0, 2.7]),
    "two layers, the weights above 0.1": ([(3, 2, WIDE, 0.9)] * 2, EVERYWHERE, 0.1, [[0, 30], [0, 0]], [27.0, 2.7]),
    # weights of 0.5, 0.3, 0.15 and 0.05
    "four layers at a pixel": (
        [(0.5, 0.5, WIDE, o) for o in (0.5, 0.6, 0.75, 0.99)], EVERYWHERE[:1, :1], 0.1, [[0, 1]] * 3 + [[0, 0]],
        [0.5, 0.3, 0.15, 0.0495],
    ),
}  # fmt: skip


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("case", CASES)
def test_counts_are_those_counted_by_hand(case, dtype, rasterizer):
    surfels, labels, min_weight, expected, sums = CASES[case]
    inputs, camera = facing(labels.shape[1], labels.shape[0], surfels, dtype)
    assert counts(rasterizer, inputs, camera, labels, 2, min_weight).tolist() == expected
    if sums is not None:
        found = rasterizer.class_contributions(inputs, camera, SETTINGS, labels, 2)[:, 1]
        assert found.tolist() == pytest.approx(sums, rel=1e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("layers", "pixels", "weight"), [(0, 540, 80.054), (1, 540, 2.5651), (2, 458, 0.09988)])
def test_counts_see_through_what_hides_a_surfel(layers, pixels, weight, dtype, rasterizer):
    """Even two opaque layers, 60 px wide, let about a thousandth of its weight through, in most of its pixels."""
    inputs, camera = facing(64, 64, [(32, 32, 60, 0.999)] * layers + [(46, 32, 4, 0.8)], dtype)
    assert counts(rasterizer, inputs, camera, HALVES, 2)[-1].tolist() == [0, pixels]
    found = rasterizer.class_contributions(inputs, camera, SETTINGS, HALVES, 2)[-1]
    assert found.tolist() == pytest.approx([0.0, weight], rel=1e-4)


def test_unlabelled_pixels_and_ids_of_no_class_are_not_counted(rasterizer):
    inputs, camera = facing(6, 5, [(3, 2, WIDE, 0.9)])
    labels = EVERYWHERE * 300
    labels[0], labels[1, :2], labels[2, 0] = IGNORE, -1, 7
    assert counts(rasterizer, inputs, camera, labels, 301).nonzero().tolist() == [[0, 7], [0, 300]]
    assert counts(rasterizer, inputs, camera, labels, 301)[0, [7, 300]].tolist() == [1, 21]
    assert counts(rasterizer, inputs, camera, labels, 300)[0, 7] == 1
    for nothing in (torch.full_like(labels, IGNORE), labels * 0 - 1):
        assert not counts(rasterizer, inputs, camera, nothing, 301).any()
