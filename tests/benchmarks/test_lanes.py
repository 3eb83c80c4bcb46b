"""The least lanes for other groups of pixels, against sets counted pixel by pixel."""

from __future__ import annotations

from collections import Counter, defaultdict

import pytest

from beags_plugin.rasterizers.native import NativeRasterizer
from benchmarks.lanes import contributing, count_lanes
from benchmarks.scenes import make_scene, parse_size

pytestmark = pytest.mark.skipif(NativeRasterizer.unavailable() is not None, reason=str(NativeRasterizer.unavailable()))


def test_lanes_are_those_of_the_groups_that_hold_a_contribution():
    scene = make_scene(parse_size("40/70x37"))
    pairs = {*zip(*(numbers.tolist() for numbers in contributing(scene)), strict=True)}
    assert len({surfel for surfel, _, _ in pairs}) > 20
    found = count_lanes(scene)
    evaluated = found.pop("evaluated")
    for width, height in ((4, 4), (4, 2), (2, 4), (4, 1), (2, 2)):
        groups = {(surfel, x // width, y // height) for surfel, x, y in pairs}
        assert found[f"groups of {width}x{height} pixels"] == width * height * len(groups) / len(pairs)
    assert evaluated >= found["groups of 4x4 pixels"]

    squares, places = defaultdict(set), defaultdict(Counter)
    for surfel, x, y in pairs:
        squares[surfel, x // 16, y // 16].add((x // 2, y // 2))
        places[surfel, x // 16, y // 16][x % 4, y % 4] += 1
    packed = sum(-(-len(of_pair) // 4) for of_pair in squares.values())
    assert found["squares of 2x2, packed"] == 16 * packed / len(pairs)
    kept = sum(max(of_pair.values()) for of_pair in places.values())
    assert found["pixels, each in its lane"] == 16 * kept / len(pairs)
