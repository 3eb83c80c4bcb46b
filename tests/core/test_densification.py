"""Densification and pruning of a handful of surfels whose fate is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from beags_plugin.core.densification import (
    GRADIENT_THRESHOLD,
    RESET_OPACITY,
    GradientStatistics,
    bounded,
    densify,
    frees_at,
    initial_surfels,
    length_units,
    reset_opacity,
    split_by_sampling,
)
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.sh import sh_colors
from beags_plugin.core.surfels import Surfels
from beags_plugin.options.stages import DensifyConfig

EXTENT = 2.0
CONFIG = DensifyConfig()
LOW, HIGH = GRADIENT_THRESHOLD * 0.99, GRADIENT_THRESHOLD * 1.01
SMALL, MIDDLE, HUGE = 0.5 * 0.01 * EXTENT, 3 * 0.01 * EXTENT, 2 * 0.1 * EXTENT


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def scene(scales, opacities) -> Surfels:
    """Surfels whose larger scale and opacity are given, turned at random."""
    count, g = len(scales), generator(3)
    larger = torch.tensor(scales).log()
    return Surfels.of(
        means=torch.randn(count, 3, generator=g),
        quats=torch.randn(count, 4, generator=g),
        log_scales=torch.stack([larger - 0.7, larger], dim=-1),
        opacity_logits=torch.logit(torch.tensor(opacities)),
        sh=torch.randn(count, 4, 3, generator=g),
    )


def run(surfels, gradients, step=1000, config=CONFIG, seed=0):
    units = torch.full((len(surfels),), EXTENT)
    return densify(surfels, torch.tensor(gradients), units, config, step, generator(seed))


def test_a_quiet_scene_stays_as_it_is():
    surfels = scene([SMALL, MIDDLE], [0.5, 0.5])
    edited = run(surfels, [LOW, LOW])
    assert edited.source.tolist() == [0, 1] and not edited.fresh.any()
    assert all(torch.equal(getattr(edited.surfels, f), getattr(surfels, f)) for f in vars(surfels))


def test_a_small_surfel_is_cloned_and_a_large_one_split():
    surfels = scene([SMALL, MIDDLE, MIDDLE], [0.5, 0.6, 0.7])
    edited = run(surfels, [HIGH, HIGH, LOW])
    assert sorted(edited.source.tolist()) == [0, 0, 1, 1, 2]
    kept = edited.source[~edited.fresh]
    assert kept.tolist() == [0, 2]  # the split surfel itself is gone, the cloned one stays
    clone = edited.surfels[(edited.source == 0) & edited.fresh]
    assert torch.equal(clone.means[0], surfels.means[0]) and torch.equal(clone.log_scales[0], surfels.log_scales[0])
    halves = edited.surfels[edited.source == 1]
    torch.testing.assert_close(halves.log_scales, (surfels.log_scales[1] - math.log(1.6)).expand(2, 2))
    assert torch.equal(halves.sh, surfels.sh[1].expand(2, -1, -1))
    offset = halves.means - surfels.means[1]
    normal = rotation_from_quat(surfels.quats[1])[:, 2]
    assert (offset.norm(dim=-1) > 0).all() and not torch.equal(*offset)
    torch.testing.assert_close(offset @ normal, torch.zeros(2), rtol=0, atol=1e-6)  # the surfel's plane


def test_halves_are_spread_like_the_surfel_they_replace():
    count = 4000
    surfels = scene([MIDDLE], [0.5])[torch.zeros(count, dtype=torch.int64)]
    edited = run(surfels, [HIGH] * count)
    local = (edited.surfels.means - surfels.means[0]) @ rotation_from_quat(surfels.quats[0])
    spread = local[:, :2].std(dim=0) / surfels.log_scales[0].exp()
    torch.testing.assert_close(spread, torch.ones(2), rtol=0, atol=0.05)  # 8000 draws: standard error 0.008


def test_the_chosen_alone_are_split_as_densification_splits():
    surfels = scene([MIDDLE, 0.16, MIDDLE, MIDDLE], [0.5, 0.01, 0.5, 0.7])  # one of them too faint for densification
    surfels.log_scales[1] = torch.tensor([0.16, 0.08]).log()
    edited = split_by_sampling(surfels, torch.tensor([False, True, False, True]), generator())
    assert edited.source.tolist() == [0, 2, 1, 3, 1, 3] and edited.fresh.tolist() == [False] * 2 + [True] * 4
    halves = edited.surfels[edited.source == 1]
    torch.testing.assert_close(halves.log_scales.exp(), torch.tensor([[0.1, 0.05]] * 2))
    changed = {"means", "log_scales"}
    for name, values in vars(edited.surfels).items():
        same = edited.fresh.logical_not() if name in changed else slice(None)
        assert torch.equal(values[same], getattr(surfels, name)[edited.source][same]), name
    offset = halves.means - surfels.means[1]
    normal = rotation_from_quat(surfels.quats[1])[:, 2]
    assert (offset.norm(dim=-1) > 0).all() and not torch.equal(*offset)
    torch.testing.assert_close(offset @ normal, torch.zeros(2), rtol=0, atol=1e-6)
    again = run(surfels, [LOW, LOW, LOW, HIGH])
    alone = split_by_sampling(surfels, torch.tensor([False, False, False, True]), generator())
    assert torch.equal(again.surfels.means[-2:], alone.surfels.means[-2:])
    nothing = split_by_sampling(surfels, torch.zeros(4, dtype=torch.bool), generator())
    assert all(torch.equal(getattr(nothing.surfels, f), value) for f, value in vars(surfels).items())


def test_faint_surfels_go_at_once_and_huge_ones_after_the_given_step():
    surfels = scene([SMALL, HUGE, MIDDLE], [0.04, 0.5, 0.5])
    assert run(surfels, [LOW] * 3, step=CONFIG.prune_scale_after).source.tolist() == [1, 2]
    assert run(surfels, [LOW] * 3, step=CONFIG.prune_scale_after + 1).source.tolist() == [2]
    never = replace(CONFIG, prune_scale_after=0)
    assert run(surfels, [LOW] * 3, config=never, step=CONFIG.prune_scale_after + 1).source.tolist() == [1, 2]


def test_far_surfels_are_measured_by_the_distance_of_the_nearest_camera():
    means = torch.tensor([[0.5, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 0.0, -30.0]])
    centers = torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    assert length_units(means, centers, EXTENT, CONFIG).tolist() == [EXTENT] * 3
    far = replace(CONFIG, far_limits=True)
    assert length_units(means, centers, EXTENT, far).tolist() == [EXTENT, 6.0, 30.0]
    assert length_units(means * math.nan, centers, EXTENT, far).shape == (3,)  # such surfels are dropped elsewhere
    # A size that is too large beside the cameras is not too large far behind what they look at.
    surfels, step = scene([HUGE, HUGE], [0.5, 0.5]), CONFIG.prune_scale_after + 1
    edited = densify(surfels, torch.tensor([LOW, LOW]), torch.tensor([EXTENT, 3 * EXTENT]), far, step, generator())
    assert edited.source.tolist() == [1]


def test_growth_stops_at_the_bound_and_prefers_large_gradients():
    surfels = scene([SMALL, MIDDLE, SMALL, SMALL], [0.5] * 4)
    config = replace(CONFIG, max_surfels=6)
    edited = run(surfels, [HIGH, 3 * HIGH, 2 * HIGH, HIGH], config=config)
    assert sorted(edited.source.tolist()) == [0, 1, 1, 2, 2, 3]
    assert run(surfels, [HIGH] * 4, config=replace(CONFIG, max_surfels=3)).source.tolist() == [0, 1, 2, 3]


def test_a_gradient_that_is_not_a_number_counts_for_nothing():
    assert run(scene([SMALL], [0.5]), [math.nan]).source.tolist() == [0]


def test_one_surfel_always_remains():
    edited = run(scene([SMALL, SMALL, SMALL], [0.01, 0.03, 0.02]), [LOW] * 3)
    assert edited.source.tolist() == [1]


def test_the_seed_alone_decides():
    surfels = scene([MIDDLE] * 3, [0.5] * 3)
    first, again, other = (run(surfels, [HIGH] * 3, seed=seed).surfels.means for seed in (1, 1, 2))
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_the_scale_of_the_scene_changes_nothing():
    surfels = scene([SMALL, MIDDLE, HUGE], [0.5] * 3)
    factor = 2.0**17
    larger = replace(surfels, means=surfels.means * factor, log_scales=surfels.log_scales + math.log(factor))
    gradients, step, units = torch.tensor([HIGH] * 3), 5000, torch.full((3,), EXTENT)
    small = densify(surfels, gradients, units, CONFIG, step, generator())
    large = densify(larger, gradients, units * factor, CONFIG, step, generator())
    assert torch.equal(small.source, large.source)
    torch.testing.assert_close(large.surfels.means / factor, small.surfels.means, rtol=1e-5, atol=1e-6)


def test_statistics_average_over_the_views_that_saw_a_surfel():
    statistics = GradientStatistics(3)
    statistics.add(torch.tensor([1.0, 5.0, math.inf]), torch.tensor([True, False, True]))
    statistics.add(torch.tensor([3.0, 7.0, 4.0]), torch.tensor([True, False, True]))
    assert statistics.mean().tolist() == [2.0, 0.0, 4.0]


def test_reset_only_lowers_opacity():
    logits = reset_opacity(scene([SMALL] * 2, [0.9, 0.001]))
    torch.testing.assert_close(torch.sigmoid(logits), torch.tensor([RESET_OPACITY, 0.001]))


@pytest.mark.parametrize("factor", [1e-4, 1.0, 1e6])
def test_initial_surfels_are_as_large_as_their_neighbours_are_far(factor):
    g = generator(7)
    points, colors = factor * torch.randn(20, 3, generator=g), torch.rand(20, 3, generator=g)
    surfels = initial_surfels(points, colors, 3, generator())
    squared = np.sort(torch.cdist(points.double(), points.double()).numpy() ** 2, axis=1)[:, 1:4].mean(axis=1)
    expected = torch.from_numpy(np.sqrt(squared)).float()[:, None].expand(-1, 2)
    torch.testing.assert_close(surfels.log_scales.exp(), expected, rtol=1e-4, atol=0)
    torch.testing.assert_close(surfels.quats.norm(dim=-1), torch.ones(20))
    torch.testing.assert_close(torch.sigmoid(surfels.opacity_logits), torch.full((20,), 0.1))
    assert surfels.sh.shape == (20, 16, 3)
    seen = sh_colors(surfels.sh_dc, surfels.sh_rest, surfels.means, torch.zeros(3), 3)
    torch.testing.assert_close(seen, colors, rtol=1e-5, atol=1e-6)


def test_coincident_and_few_points_give_finite_surfels():
    cloud = torch.cat([torch.zeros(5, 3), torch.ones(1, 3)])
    for points in (cloud, cloud[:1], cloud[4:]):
        surfels = initial_surfels(points, torch.full_like(points, 0.5), 0, generator())
        assert all(torch.isfinite(value).all() for value in vars(surfels).values())
        assert (surfels.log_scales.exp() > 0).all()


def test_the_bound_by_pixels():
    assert bounded(CONFIG, 1000) == CONFIG
    config = replace(CONFIG, pixels_per_surfel=50.0)
    assert bounded(config, 1000).max_surfels == 20 and bounded(config, 10).max_surfels == 1
    assert bounded(replace(config, max_surfels=7), 1000).max_surfels == 7
    assert bounded(replace(config, max_surfels=90), 1000).max_surfels == 20


def test_the_space_before_cameras_is_freed_in_each_round_to_the_end_of_the_base():
    config = replace(CONFIG, free_share=0.5)
    steps = [done for done in range(1, 40_000) if frees_at(config, done, 30_000)]
    assert steps == list(range(600, 30_000, 100))
    assert not any(frees_at(CONFIG, done, 30_000) for done in steps)
