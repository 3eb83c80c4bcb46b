"""InstaScene's tracking, on views made by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from raster_scenes import FLOATS, facing

from beags_baselines.mask_tracking import MIN_GAUSSIANS, MIN_WEIGHT, TracedView, TrackedMasks, tracked_masks
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings


def view_of(classes: dict[int, int]) -> TracedView:
    """Return a view in which Gaussian i is traced to class ``classes[i]``, with one pixel each."""
    keys = [10 * gaussian + class_id for gaussian, class_id in sorted(classes.items())]
    return TracedView.of_counts(torch.tensor(keys), torch.ones(len(keys), dtype=torch.int32), 10)


def spread(*counts: tuple[int, int]) -> dict[int, int]:
    """Return class ``c`` for the next ``n`` Gaussians of each (n, c); None of class 0."""
    listed = [class_id for count, class_id in counts for _ in range(count)]
    return {gaussian: class_id for gaussian, class_id in enumerate(listed) if class_id}


WHOLE = spread((100, 1))  # the mask of 100 Gaussians that is asked about
ZEROS, CONTAINED, SPLIT = spread((75, 0), (25, 1)), spread((30, 0), (60, 3), (10, 4)), spread((30, 0), (50, 3), (20, 4))


def suspect(*others: dict[int, int], least: int = 80) -> bool:
    """Return whether the mask of class 1 in view 0 is under-segmented, seen from views without such masks."""
    return (0, 1) in tracked_masks([view_of(each) for each in (WHOLE, *others)], 2_000, 10, least).suspect


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        ([], False),  # contained in itself
        ([CONTAINED], False),  # 60 : 10 is 0.857
        ([SPLIT], True),  # 50 : 20 is 0.714; split in one of two
        ([SPLIT, CONTAINED], True),  # split in one of three
        ([SPLIT, CONTAINED, CONTAINED], False),  # split in one of four
        ([SPLIT, ZEROS, ZEROS], True),  # three quarters have no class: not shown there
        ([SPLIT, CONTAINED, spread((69, 0), (31, 1))], False),  # shown in one of four, in one split
        ([spread((80, 0), (20, 4)), SPLIT, CONTAINED], True),
    ],
)
def test_a_mask_that_is_split_where_it_shows_is_under_segmented(others, expected):
    assert suspect(*others) is expected


def test_masks_of_few_gaussians_are_not_tracked():
    assert not suspect(SPLIT, least=101)
    assert tracked_masks([view_of(WHOLE), view_of(SPLIT)], 2_000, 10, min_gaussians=101).suspect == frozenset()


def test_the_ground_splits_masks_only_if_it_votes():
    views = [view_of(WHOLE), TracedView.of_counts(*ground_and_object(), 10)]
    assert (0, 1) not in tracked_masks(views, 2_000, 10, 80).suspect
    assert (0, 1) in tracked_masks(views, 2_000, 10, 80, ground_votes=True).suspect


def ground_and_object() -> tuple[torch.Tensor, torch.Tensor]:
    """Counts of a view in which 50 are on the ground and 50 of class 3."""
    keys = torch.tensor([10 * i + (0 if i < 50 else 3) for i in range(100)])
    return keys, torch.ones(100, dtype=torch.int32)


def test_seeds_are_traced_to_the_class_in_more_than_half_of_its_views():
    traced = [WHOLE] * 5
    # Gaussian 200 is traced in 3 of 5 views; in 2 of 4, hidden in the fifth; in all.
    views = [{**each, 200: 1 if place < 3 else 2} for place, each in enumerate(traced)]
    views = [{**each, 201: 1 if place < 2 else 2} if place < 4 else each for place, each in enumerate(views)]
    found = tracked_masks([view_of(each) for each in views], 2_000, 10)
    assert found.suspect == frozenset()
    assert found.seeds[1].tolist() == [*range(100), 200]
    assert [len(each) for each in found.seeds] == [0, 101, *[0] * 8]
    assert found.seed_classes(300).nonzero()[:, 0].tolist() == [*range(100), 200]
    assert [len(each) for each in tracked_masks([view_of(WHOLE)], 2_000, 10).seeds] == [0] * 10, "two views are needed"


def test_pixels_of_the_background_count_as_traced():
    views = [{**WHOLE, 200: 1 if place < 2 else 0} for place in range(4)]
    assert view_of(views[3]).traced.tolist() == [*range(100), 200]
    assert 200 not in tracked_masks([view_of(each) for each in views], 2_000, 10).seeds[1].tolist()
    hidden = [{**WHOLE, 200: 1} if place < 2 else WHOLE for place in range(4)]
    assert 200 in tracked_masks([view_of(each) for each in hidden], 2_000, 10).seeds[1].tolist()


def test_an_under_segmented_mask_of_one_classs_seeds_is_taken_back():
    """The mask of class 5 in view 0 covers two objects, 3 and 4, that other views tell apart."""
    apart = spread((60, 3), (60, 4))
    views = [spread((120, 5)), apart, apart, apart]
    assert tracked_masks([view_of(each) for each in views], 2_000, 10).suspect == frozenset({(0, 5)})
    mostly = spread((79, 3), (20, 4))  # 0.798 of it are of class 3: split where it shows
    found = tracked_masks([view_of(each) for each in (spread((99, 5)), *[mostly] * 3)], 2_000, 10)
    assert found.suspect == frozenset({(0, 5)}), "not more than 0.8 are seeds of one class"
    # split in three of eight views, but all seeds of 3, whose masks are larger
    torn, larger = spread((60, 6), (39, 7), (200, 6)), spread((299, 3))
    views = [view_of(each) for each in (spread((99, 5)), *[larger] * 4, *[torn] * 3)]
    found = tracked_masks(views, 2_000, 10, min_gaussians=70)
    assert found.suspect == frozenset() and len(found.seeds[3]) == 299
    fewer = [view_of(each) for each in (spread((99, 5)), *[spread((50, 0), (249, 3))] * 4, *[torn] * 3)]
    assert (0, 5) in tracked_masks(fewer, 2_000, 10, min_gaussians=70).suspect


def test_filtered_maps_lose_suspect_masks_of_their_view_alone():
    tracked = TrackedMasks((torch.zeros(0).long(),), frozenset({(2, 1), (3, 2)}))
    ranks = torch.tensor([[0, 1, 2, 65535]], dtype=torch.int32)
    assert tracked.filtered(2, ranks).tolist() == [[0, 0, 2, 65535]]
    assert tracked.filtered(1, ranks).tolist() == ranks.tolist() and ranks[0, 1] == 1


def test_the_strongest_class_wins_and_ties_go_to_the_lower():
    keys = torch.tensor([0 * 10 + 0, 0 * 10 + 2, 1 * 10 + 2, 1 * 10 + 3, 2 * 10 + 2, 2 * 10 + 3, 4 * 10 + 0])
    found = TracedView.of_counts(keys, torch.tensor([9, 1, 2, 3, 4, 4, 2], dtype=torch.int32), 10)
    assert found.strongest(6).tolist() == [2, 3, 2, 0, 0, 0]
    assert found.strongest(6, ground=True).tolist() == [1, 4, 3, 0, 1, 0]
    assert TracedView.of_counts(keys[:0], keys[:0], 10).strongest(3).tolist() == [0, 0, 0]


def test_three_of_four_layers_are_traced(rasterizer):
    """Weights of 0.5, 0.3, 0.15 and 0.05 at a pixel."""
    inputs, camera = facing(1, 1, [(0.5, 0.5, 1e4, opacity) for opacity in (0.5, 0.6, 0.75, 0.99)])
    labels, settings = torch.ones(1, 1, dtype=torch.int32), RasterSettings(0.1, 100.0, geometry=False)
    found = rasterizer.sparse_class_pixel_counts(inputs, camera, settings, labels, 3, MIN_WEIGHT)
    assert TracedView.of_counts(*found, 3).traced.tolist() == [0, 1, 2]


class Wall:
    """Gaussians of 1.5 pixels, two apart, with a round object of some radius in pixels among those of another one."""

    def __init__(self, radius: int) -> None:
        size, generator = 2 * (radius + 8), torch.Generator().manual_seed(0)
        grid = torch.arange(1.0, size, 2.0)
        xy = torch.cartesian_prod(grid, grid)
        xy = (xy + 2.0 * torch.rand(xy.shape, generator=generator) - 1.0)[torch.randperm(len(xy), generator=generator)]
        self.inputs, self.camera = facing(size, size, [(x, y, 1.5, 0.9) for x, y in xy.tolist()], torch.float32)
        pixels = torch.arange(size) + 0.5 - size / 2
        self.inside = (pixels[:, None].square() + pixels.square()).sqrt() < radius
        self.labels = torch.where(self.inside, 1, 2).int()
        self.rasterizer, self.settings = make_rasterizer("auto"), RasterSettings(0.1, 100.0, geometry=False)

    def __len__(self) -> int:
        return len(self.inputs.means)

    def views(self, min_weight: float) -> list[TracedView]:
        what = (self.inputs, self.camera, self.settings, self.labels, 3, min_weight)
        return [TracedView.of_counts(*self.rasterizer.sparse_class_pixel_counts(*what), 3)] * 3

    def seeds(self, min_weight: float, min_gaussians: int = 5) -> torch.Tensor:
        return tracked_masks(self.views(min_weight), len(self), 3, min_gaussians).seeds[1]

    def assigned(self) -> torch.Tensor:
        shares = self.rasterizer.class_contributions(self.inputs, self.camera, self.settings, self.labels, 3)
        return (shares.argmax(dim=1) == 1).nonzero()[:, 0]

    def excess(self, members: torch.Tensor) -> tuple[float, float]:
        """Return by how many pixels the radius of the members, drawn alone, is too large, and their IoU."""
        alone = replace(self.inputs, **{name: getattr(self.inputs, name)[members] for name in FLOATS})
        alpha = self.rasterizer.rasterize(alone, self.camera, self.settings, torch.zeros(3)).alpha
        drawn = alpha.view(self.inside.shape) > 0.5
        iou = (drawn & self.inside).sum() / (drawn | self.inside).sum()
        return float((drawn.sum() / torch.pi).sqrt() - (self.inside.sum() / torch.pi).sqrt()), float(iou)


def test_seeds_reach_as_far_beyond_a_small_object_as_beyond_a_large_one():
    """Seeds reach nearly two Gaussian sizes too far, assignment less; what that costs falls as the object grows."""
    by_seeds, by_assignment = [], []
    for wall in (Wall(20), Wall(40)):
        by_seeds.append(wall.excess(wall.seeds(MIN_WEIGHT, MIN_GAUSSIANS)))
        by_assignment.append(wall.excess(wall.assigned()))
    assert all(2.3 < excess < 3.0 for excess, _ in by_seeds), by_seeds
    assert all(1.0 < excess < 1.5 for excess, _ in by_assignment), by_assignment
    small, large = (mine - seeds for (_, mine), (_, seeds) in zip(by_assignment, by_seeds, strict=True))
    assert small > 0.1 and large < 0.6 * small


def test_with_a_higher_weight_seeds_keep_to_the_object():
    wall = Wall(20)
    excess = [wall.excess(wall.seeds(weight))[0] for weight in (0.1, 0.2, 0.3)]
    assert excess == sorted(excess, reverse=True) and excess[0] - excess[2] > 1.0
    assert excess[2] == pytest.approx(wall.excess(wall.assigned())[0], abs=0.5)


@pytest.mark.parametrize(("radius", "min_weight", "left_out"), [(12, 0.1, True), (24, 0.1, False), (12, 0.3, False)])
def test_a_small_object_that_touches_another_loses_its_masks(radius, min_weight, left_out):
    """A fifth of the Gaussians of its mask at its rim are of the other, in every view: under-segmented everywhere."""
    wall = Wall(radius)
    views = wall.views(min_weight)
    own = views[0].members[views[0].classes == 1].long()
    alike = (views[0].strongest(len(wall))[own] == 1).float().mean()
    found = tracked_masks(views, len(wall), 3)
    assert bool(alike < 0.8) is left_out and len(own) > MIN_GAUSSIANS
    assert ({(view, 1) for view in range(3)} <= found.suspect) is left_out
    assert bool(len(found.seeds[1]) == 0) is left_out
