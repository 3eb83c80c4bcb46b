"""Mask damage that views share: regions of space, in most training masks, and nothing else changed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from sample_checks import TINY, files, grey, splits
from scene_distances import distance
from scipy.ndimage import maximum_filter
from scipy.spatial.distance import cdist

from beags_benchmarks.samples.config import VariedSample
from beags_benchmarks.samples.damage import Beyond, Near, flawed_mask, plan_flaws
from beags_plugin.sample import FAMILIES
from beags_plugin.sample.degrade import PRESETS, degrade_mask
from beags_plugin.sample.points import Photo, shown_in
from beags_plugin.sample.tracing import first_hits
from beags_plugin.sample.views import pixel_directions
from beags_plugin.sample.writer import write_sample
from beags_plugin.system.errors import UserError

SEED, SHARE = 2, 0.6


@pytest.fixture(scope="module", params=FAMILIES.names())
def family(request):
    return request.param


@pytest.fixture(scope="module")
def shown(family):
    """(scene, flaws, photos, labels, masks, points) of twelve training views."""
    made = FAMILIES.get(family)
    scene = made.scene(SEED)
    views = [view for view in made.views(SEED, 96, 72, 12, 1) if view.split == "train"]
    flaws = plan_flaws(scene, [view.name for view in views], SEED, SHARE)
    depths, labels, points = zip(*(traced(scene, view) for view in views), strict=True)
    photos = [Photo(view, scene) for view in views]
    masks = [flawed_mask(exact, depth, view, flaws) for exact, depth, view in zip(labels, depths, views, strict=True)]
    return scene, flaws, photos, labels, masks, points


def traced(scene, view):
    """The depth and the labels of a photo, and [H W, 3] float64 world points that the pixel centres show."""
    rays = pixel_directions(view)
    hits, _ = first_hits(scene, view.center, rays)
    shape = (view.height, view.width)
    labels = np.maximum(hits.surface, 0).astype(np.uint8).reshape(shape)
    return hits.t.astype(np.float32).reshape(shape), labels, view.center + hits.t[:, None] * rays


def depth_in(region, points):
    """[P] how far points lie inside a region, negative outside."""
    if isinstance(region, Beyond):
        return points @ region.way - region.limit
    return region.radius - cdist(points, region.points).min(axis=1)


def test_half_of_the_objects_have_a_flaw_in_a_share_of_the_views(shown):
    scene, flaws, photos, *_ = shown
    objects = [flaw.instead or next(iter(flaw.wrong)) for flaw in flaws]
    assert len(set(objects)) == len(flaws) == (len(scene.things) + 1) // 2
    for flaw, class_id in zip(flaws, objects, strict=True):
        below = {contact.second for contact in scene.contacts if contact.first == class_id}
        taken_in = isinstance(flaw.region, Near)
        assert (flaw.wrong, flaw.instead) == (({*below, 0}, class_id) if taken_in else ({class_id}, 0))
        assert len(flaw.views) == round(SHARE * len(photos)) == 7
    assert {type(flaw.region) for flaw in flaws} == {Near, Beyond}
    assert len({frozenset(flaw.views) for flaw in flaws}) > 1


def test_a_mask_is_wrong_inside_the_regions_of_its_view_and_nowhere_else(shown):
    _, flaws, photos, labels, masks, places = shown
    for photo, truth, mask, points in zip(photos, labels, masks, places, strict=True):
        expected = truth.copy()
        doubtful = np.zeros(truth.size, dtype=bool)  # depth is written in float32
        for flaw in flaws:
            inside = depth_in(flaw.region, points)
            doubtful |= np.abs(inside) < 1e-5
            if photo.view.name in flaw.views:
                expected[np.isin(truth, list(flaw.wrong)) & (inside > 0).reshape(truth.shape)] = flaw.instead
        assert doubtful.mean() < 0.01 and mask.dtype == truth.dtype
        assert np.array_equal(mask.ravel()[~doubtful], expected.ravel()[~doubtful])


def test_views_agree_on_what_is_wrong(shown):
    """A place that one mask has wrong is wrong in the other masks with the flaw, and right in those without."""
    _, flaws, photos, labels, masks, places = shown
    compared = 0
    for flaw in flaws:
        wrong = [
            (m != truth) & np.isin(truth, list(flaw.wrong)) & (m == flaw.instead)
            for m, truth in zip(masks, labels, strict=True)
        ]
        agree = {True: [], False: []}
        for photo, here, points in zip(photos, wrong, places, strict=True):
            for other, there in zip(photos, wrong, strict=True):
                if other is not photo:
                    rest = points[here.ravel()]
                    rest = rest[shown_in(other, rest)] - other.view.center
                    x, y, z = (rest @ other.view.camera_to_world[:3, :3]).T
                    column = np.floor(other.view.cx - other.view.focal * x / z).astype(int)
                    row = np.floor(other.view.cy + other.view.focal * y / z).astype(int)
                    near = maximum_filter(there, 3)  # a pixel's centre shows a place beside it
                    agree[other.view.name in flaw.views] += near[row, column].tolist()
        if len(agree[True]) > 50:
            compared += 1
            assert np.mean(agree[True]) > 0.85 and not any(agree[False])
    assert compared > 1


@pytest.mark.parametrize("family", ["tabletop", "room"])
@pytest.mark.parametrize("seed", range(3))
def test_what_is_wrong_is_at_the_foot_and_can_be_seen(family, seed):
    made = FAMILIES.get(family)
    scene = made.scene(seed)
    view = made.views(seed, 160, 120, 12, 1)[6]
    depth, labels, points = traced(scene, view)
    changed = []
    for flaw in plan_flaws(scene, [view.name], seed, 1.0):
        class_id = flaw.instead or next(iter(flaw.wrong))
        wrong = (flawed_mask(labels, depth, view, [flaw]) != labels).ravel()
        own = points[labels.ravel() == class_id]
        size = 2.0 * scene.things[class_id - 1].solid.bound
        if isinstance(flaw.region, Near):
            assert np.abs(distance(scene.things[class_id - 1], flaw.region.points)).max() < 1e-4
            assert 0.05 * size < flaw.region.radius < 0.2 * size
            assert (points[wrong][:, 2] < flaw.region.points[:, 2].min() + 0.35 * size).all()
        else:
            assert wrong.sum() < 0.4 * len(own)
            middle = own.mean(axis=0)
            assert not wrong.any() or (points[wrong].mean(axis=0) - middle) @ flaw.region.way > 0.0
        changed.append(wrong.sum() / max(len(own), 1))
    assert np.count_nonzero(np.array(changed) > 0.03) >= 2


def test_the_seed_decides(family):
    scene, names = FAMILIES.get(family).scene(SEED), [f"view_{i:03d}" for i in range(20)]

    def plan(seed, order=1, share=SHARE):
        return [
            (flaw.wrong, flaw.instead, flaw.views, *map(np.ndarray.tolist, map(np.asarray, vars(flaw.region).values())))
            for flaw in plan_flaws(scene, names[::order], seed, share)
        ]

    assert plan(SEED) == plan(SEED, order=-1) != plan(SEED + 1)
    assert [flaw[3:] for flaw in plan(SEED)] != [flaw[3:] for flaw in plan(SEED + 1)]  # regions, not views alone
    assert plan(SEED, share=0.0) == []
    fewer, more = plan(SEED, share=0.3), plan(SEED)
    assert all(few[2] < many[2] and few[3:] == many[3:] for few, many in zip(fewer, more, strict=True))


def test_a_sample_has_it_in_training_masks_alone(tmp_path):
    config = VariedSample(**{**vars(TINY), "width": 48, "height": 32, "degradation": "none"})
    plain = write_sample(tmp_path / "plain", config)
    shared = write_sample(tmp_path / "shared", dataclasses.replace(config, shared_damage=SHARE))
    mild = write_sample(tmp_path / "mild", dataclasses.replace(config, shared_damage=SHARE, degradation="mild"))
    before, now = files(plain), files(shared)
    different = {path for path in before if before[path] != now[path]}
    assert before.keys() == now.keys() and "sample.json" in different
    train, _ = splits(plain)
    assert {"sample.json"} < different <= {"sample.json", *(f"masks/{stem}.png" for stem in train)}
    classes = 1 + len(FAMILIES.get(config.family).scene(config.seed).things)
    for stem in train:
        truth = grey(plain / f"ground_truth/masks/{stem}.png")
        assert np.array_equal(grey(plain / f"masks/{stem}.png"), truth)
        mask = mild / f"masks/{stem}.png"
        if mask.exists():  # the independent damage comes after the shared
            flawed = grey(shared / f"masks/{stem}.png")
            expected = degrade_mask(flawed, classes, PRESETS["mild"], config.seed, stem)
            assert np.array_equal(grey(mask), expected)


@pytest.mark.parametrize("wrong", [-0.1, 1.5, float("nan")])
def test_a_share_is_from_0_to_1(tmp_path, wrong):
    with pytest.raises(UserError, match=f"the sample's shared_damage is {wrong}: give a share of views from 0 to 1"):
        write_sample(tmp_path / "s", VariedSample(shared_damage=wrong))
    assert list(tmp_path.iterdir()) == []
