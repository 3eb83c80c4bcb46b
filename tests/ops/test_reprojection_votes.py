"""The compiled votes, pairwise and per voxel, against the torch versions and against loops."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from voted_views import METHODS, larger_scene, reprojection_scene, same

from beags_plugin.core.lifting import lift
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.masks import voxel_reprojection
from beags_plugin.masks.voxel_reprojection import reproject_voxel
from beags_plugin.ops import extension

compiled = pytest.mark.skipif(extension.load() is None, reason="beags_plugin._native was not built")
both = pytest.mark.usefixtures("ops")


@compiled
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("tau", [0.005, 0.02, math.inf])
@pytest.mark.parametrize("method", METHODS)
def test_both_are_their_torch_versions(method, tau, dtype, without_extension):
    scene = larger_scene(dtype)
    found, expected = list(method(*scene, tau=tau)), without_extension(lambda: list(method(*scene, tau=tau)))
    assert same(found, expected)
    changed = [(new.labels != old).double().mean() for new, old in zip(found, scene[2], strict=True) if old is not None]
    assert min(changed) > 0.001
    assert (found[3].labels != IGNORE).double().mean() > 0.1  # the view without a mask got one
    assert len(torch.cat([mask.confidence.view(-1) for mask in found]).unique()) >= 4


@compiled
@pytest.mark.parametrize("method", METHODS)
def test_any_number_of_threads_gives_the_same_bits(method, for_threads):
    scene = larger_scene()
    runs = for_threads(lambda: list(method(*scene)))
    assert same(runs[0], runs[1]) and same(runs[0], runs[2])


@compiled
@pytest.mark.parametrize("method", METHODS)
def test_the_masks_that_were_given_stay_as_they_were(method):
    depths, cameras, labels, num_classes = larger_scene()
    before = [None if mask is None else mask.clone() for mask in labels]
    list(method(depths, cameras, labels, num_classes))
    assert all(a is None or torch.equal(a, b) for a, b in zip(before, labels, strict=True))


@both
@pytest.mark.parametrize("method", METHODS)
def test_no_views_and_no_masks(method):
    assert list(method([], [], [], 2)) == []
    depths, cameras, _ = reprojection_scene()
    for result in method(depths, cameras, [None] * 4, 2):
        assert (result.labels == IGNORE).all() and not result.confidence.any()


def _poll(point, votes):
    """Votes about a point, weighted in 64ths of a voxel by how near the eight voxels are; whether these agree."""
    corner = [math.floor(value - 0.5) for value in point]
    parts = [int(64 * (value - 0.5 - c)) for value, c in zip(point, corner, strict=True)]
    poll: dict[int, int] = {}
    leaders = set()
    for offset in itertools.product((0, 1), repeat=3):
        here = votes.get(tuple(c + o for c, o in zip(corner, offset, strict=True)))
        weight = math.prod(part if o else 64 - part for part, o in zip(parts, offset, strict=True))
        if here:
            leaders.add(next((label for label, n in here.items() if 2 * n > sum(here.values())), None))
        for label, n in (here or {}).items():
            poll[label] = poll.get(label, 0) + weight * n
    return poll, len(leaders) == 1 and None not in leaders


def _read(point, step, label, votes):
    """The label and the confidence of one pixel, and whether it was read a step before and behind its point."""
    poll, agreed = _poll(point, votes)
    if not agreed:
        for k in (-1, 1):
            for other, n in _poll([p + k * s for p, s in zip(point, step, strict=True)], votes)[0].items():
                poll[other] = poll.get(other, 0) + n
    leaders = [other for other, n in poll.items() if n and n == max(poll.values())]
    label = leaders[0] if len(leaders) == 1 else label
    own = votes.get(tuple(math.floor(value) for value in point))
    if own:
        return label, own.get(label, 0) / sum(own.values()), not agreed
    total = sum(poll.values())
    return label, max(poll.values()) / total if total else 0.0, not agreed


@both
@pytest.mark.parametrize(("pixels", "look"), [(0.6, 0.4), (10.0, 2.0), (None, 2.0)])
def test_voxels_equal_loops(monkeypatch, pixels, look):
    """Each pixel's label from a dictionary of votes per voxel. pixels: how far depths disagree."""
    monkeypatch.setattr(voxel_reprojection, "disagreement", lambda *_: pixels)
    monkeypatch.setattr(voxel_reprojection, "VOXEL_PIXELS", 1.5)
    depths, cameras, labels = reprojection_scene()
    g = torch.Generator().manual_seed(5)
    labels = [None if m is None else torch.where(torch.rand(m.shape, generator=g) < 0.5, 1, m) for m in labels]
    calls = []
    results = list(reproject_voxel(depths, cameras, labels, 3, progress=lambda *state: calls.append(state)))
    of_objects = [d[(d > 0) & (m > 0) & (m != IGNORE)] for d, m in zip(depths, labels, strict=True) if m is not None]
    footprints = sorted((torch.cat(of_objects) / math.sqrt(9.0 * 8.5)).tolist())
    size = 1.5 * footprints[(len(footprints) - 1) // 2]
    origin = torch.stack([camera.center for camera in cameras]).mean(0)
    points = [((lift(d, c) - origin) / size).view(-1, 3).tolist() for d, c in zip(depths, cameras, strict=True)]
    votes: dict[tuple, dict[int, int]] = {}
    for depth, mask, found in zip(depths, labels, points, strict=True):
        if mask is None:
            continue
        for d, label, point in zip(depth.view(-1).tolist(), mask.view(-1).tolist(), found, strict=True):
            if d > 0 and label != IGNORE:
                here = votes.setdefault(tuple(math.floor(value) for value in point), {})
                here[label] = here.get(label, 0) + 1
    changed, along_ray = 0, []
    for i, (depth, camera, mask, result) in enumerate(zip(depths, cameras, labels, results, strict=True)):
        old = [IGNORE] * depth.numel() if mask is None else mask.view(-1).tolist()
        rays = (lift(torch.ones_like(depth), camera) - camera.center).view(-1, 3)
        middle = torch.linalg.inv(camera.K) @ torch.tensor([camera.width / 2, camera.height / 2, 1.0]).double()
        steps = (look * rays / middle.norm()).tolist()  # `look` voxels long where the ray is that of the image's centre
        found = zip(result.labels.view(-1).tolist(), result.confidence.view(-1).tolist(), strict=True)
        for d, label, point, step, pair in zip(depth.view(-1).tolist(), old, points[i], steps, found, strict=True):
            expected = _read(point, step, label, votes) if d > 0 else (label, 0.0, False)
            assert pair == (expected[0], pytest.approx(expected[1]))
            changed += expected[0] != label
            along_ray.append(expected[2])
    assert changed > 30
    assert 10 < sum(along_ray) < len(along_ray) - 50  # both ways of reading occur
    assert calls == [(i, 8) for i in range(1, 9)]


@both
@pytest.mark.parametrize("factor", [1e-4, 1e6])
def test_voxels_scale_with_the_scene(factor):
    depths, cameras, labels = reprojection_scene(seed=2)
    scaled = [type(c)(c.viewmat.clone(), c.K, c.width, c.height) for c in cameras]
    for camera in scaled:
        camera.viewmat[:3, 3] *= factor
    before = list(reproject_voxel(depths, cameras, labels, 3))
    after = list(reproject_voxel([factor * depth for depth in depths], scaled, labels, 3))
    agree = [(a.labels == b.labels).double().mean() for a, b in zip(before, after, strict=True)]
    assert min(agree) > 0.95  # a point on a voxel's face may round to either side


@both
def test_too_distant_points_neither_vote_nor_change():
    depths, cameras, labels = reprojection_scene()
    depths[0][2, 3] = 1e9
    results = list(reproject_voxel(depths, cameras, labels, 3))
    assert int(results[0].labels[2, 3]) == int(labels[0][2, 3]) and float(results[0].confidence[2, 3]) == 0.0
