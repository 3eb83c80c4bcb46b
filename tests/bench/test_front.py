"""The picture of the Pareto front: which costs it shows, and that the numbers of many variants can be read."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

pytest.importorskip("nerfstudio")

from beags_plugin.bench.experiment import Variant
from beags_plugin.bench.front import MEMORY, REFINEMENT, TOTAL, costs, pareto_front
from beags_plugin.bench.point_labels import label_points
from beags_plugin.bench.report import new_figure
from beags_plugin.bench.results import FIGURES, ResultRow


def row(name: str, figures: dict[str, float] | None = None, base: dict | None = None) -> ResultRow:
    return ResultRow(Variant(name, base or {}), "a", 0, {**dict.fromkeys(FIGURES), **(figures or {})}, {})


def test_the_seconds_of_a_base_that_all_share_are_left_out():
    shared = [row("a"), row("b")]
    assert costs(shared) == (REFINEMENT, MEMORY)
    assert costs([*shared, row("c", base={"pipeline.model.base_steps": 700})]) == (TOTAL, MEMORY)
    seconds, biou = (30.0, 3.0, 45.0, 40.0, 3.0), (0.8, 0.5, 0.9, 0.79, 0.4)
    rows = [
        row(str(i), {"cpu_seconds": x, "extracted_biou_after": y, "cpu_seconds total": x + 500.0})
        for i, (x, y) in enumerate(zip(seconds, biou, strict=True))
    ]
    fronts = [pareto_front(rows, cost, "extracted_biou_after") for cost, _ in (REFINEMENT, TOTAL)]
    assert fronts[0] == fronts[1] == [rows[1], rows[0], rows[2]]


def covers(one, other) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


@pytest.mark.parametrize("seed", range(3))
def test_labels_of_many_points_cover_neither_each_other_nor_points(seed):
    """Thirty points, half of them on three spots, as of methods that leave the base alone."""
    from matplotlib import pyplot

    random = np.random.default_rng(seed)
    free, spots = random.uniform(0, 1, (15, 2)), random.uniform(0, 1, (3, 2))
    places = np.concatenate([free, spots[random.integers(0, 3, 15)] + random.normal(0, 0.002, (15, 2))])
    figure, axes = new_figure(1, 1, size=(6.5, 5.0))
    axes[0, 0].plot(*places.T, "o")
    figure.canvas.draw()
    points = [(x, y, str(number), "black") for number, (x, y) in enumerate(places, start=1)]
    path = [(0.0, 0.1), (0.5, 0.1), (0.5, 0.9), (1.0, 0.9)]
    labels = label_points(axes[0, 0], points, path)
    frame = axes[0, 0].get_window_extent().extents
    assert len(labels) == len(points)
    assert not [pair for pair in combinations(labels, 2) if covers(*pair)]
    pixels = axes[0, 0].transData.transform(places)
    assert not [label for label in labels for x, y in pixels if covers(label, (x - 3, y - 3, x + 3, y + 3))]
    assert all(f[0] <= b[0] and f[1] <= b[1] and b[2] <= f[2] and b[3] <= f[3] for b in labels for f in [frame])
    middles = np.array([((left + right) / 2, (bottom + top) / 2) for left, bottom, right, top in labels])
    away = np.abs(middles - pixels).max(axis=1)
    assert away.max() < 150 and np.median(away) < 30
    written = [text.get_window_extent().extents for text in axes[0, 0].texts]
    assert all(covers(one, other) == (i == j) for i, one in enumerate(written) for j, other in enumerate(labels))
    pyplot.close(figure)
