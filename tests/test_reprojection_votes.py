"""The compiled votes, pairwise and per voxel, against the torch versions and against loops."""

from __future__ import annotations

import math

import pytest
import torch
from test_reprojection import SIZES, _cameras, _scene

from beags_plugin.core.lifting import lift
from beags_plugin.masks import REPROJECTIONS, voxel_reprojection
from beags_plugin.masks.reprojection import reproject_pairwise
from beags_plugin.masks.voxel_reprojection import reproject_voxel
from beags_plugin.ops import extension
from beags_plugin.rasterizers.interface import IGNORE

compiled = pytest.mark.skipif(extension.load() is None, reason="beags_plugin._native was not built")
both = pytest.mark.usefixtures("ops")
METHODS = [reproject_pairwise, reproject_voxel]


def larger_scene(dtype=torch.float32, num_classes: int = 5):
    """Views of a slanted wall that overlap, with noisy depth, holes and poison; wider than one strip of pixels."""
    sizes = [(71, 23), (90, 31), (64, 40), (71, 23), (83, 29)]
    g = torch.Generator().manual_seed(2)
    cameras, depths, labels = [], [], []
    for index, (camera, (width, height)) in enumerate(zip(_cameras(sizes), sizes, strict=True)):
        camera.K[0, 0], camera.K[1, 1] = 70.0, 69.0
        cameras.append(camera)
        x = torch.linspace(0, 1, width, dtype=torch.float64)
        depth = (3.0 + 0.4 * x + 0.01 * torch.randn(height, width, generator=g, dtype=torch.float64)).to(dtype)
        depth[torch.rand(height, width, generator=g) < 0.05] = 0.0
        for value, where in zip((math.nan, math.inf, -1.0), (7, 70, 99), strict=True):
            depth.view(-1)[where] = value
        depths.append(depth)
        mask = ((x * 4).floor().int() + (torch.rand(height, width, generator=g) < 0.2).int()).clamp(max=num_classes - 1)
        mask[torch.rand(height, width, generator=g) < 0.1] = IGNORE
        labels.append(None if index == 3 else mask.int())
    return depths, cameras, labels, num_classes


def same(found, expected) -> bool:
    pairs = zip(found, expected, strict=True)
    return all(torch.equal(a.labels, b.labels) and torch.equal(a.confidence, b.confidence) for a, b in pairs)


@compiled
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("tau", [0.005, 0.02, math.inf])
@pytest.mark.parametrize("method", METHODS)
def test_both_are_their_torch_versions(method, tau, dtype, without_extension):
    scene = larger_scene(dtype)
    found, expected = method(*scene, tau=tau), without_extension(lambda: method(*scene, tau=tau))
    assert same(found, expected)
    changed = [(new.labels != old).double().mean() for new, old in zip(found, scene[2], strict=True) if old is not None]
    assert min(changed) > 0.001
    assert (found[3].labels != IGNORE).double().mean() > 0.1  # the view without a mask got one
    assert len(torch.cat([mask.confidence.view(-1) for mask in found]).unique()) >= 4


@compiled
@pytest.mark.parametrize("method", METHODS)
def test_any_number_of_threads_gives_the_same_bits(method, for_threads):
    scene = larger_scene()
    runs = for_threads(lambda: method(*scene))
    assert same(runs[0], runs[1]) and same(runs[0], runs[2])


@compiled
@pytest.mark.parametrize("method", METHODS)
def test_the_masks_that_were_given_stay_as_they_were(method):
    depths, cameras, labels, num_classes = larger_scene()
    before = [None if mask is None else mask.clone() for mask in labels]
    method(depths, cameras, labels, num_classes)
    assert all(a is None or torch.equal(a, b) for a, b in zip(before, labels, strict=True))


@both
@pytest.mark.parametrize("method", METHODS)
def test_no_views_and_no_masks(method):
    assert method([], [], [], 2) == []
    depths, cameras, _ = _scene()
    for result in method(depths, cameras, [None] * 4, 2):
        assert (result.labels == IGNORE).all() and not result.confidence.any()


@both
def test_voxels_equal_loops(monkeypatch):
    """Each pixel's label from a dictionary of votes per voxel."""
    monkeypatch.setattr(voxel_reprojection, "VOXEL_PIXELS", 3.0)
    depths, cameras, labels = _scene()
    calls = []
    results = reproject_voxel(depths, cameras, labels, 3, progress=lambda *state: calls.append(state))
    footprints = [d / math.sqrt(9.0 * 8.5) for depth in depths for d in depth.view(-1).tolist() if d > 0]
    size = 3.0 * sorted(footprints)[(len(footprints) - 1) // 2]
    origin = torch.stack([camera.center for camera in cameras]).mean(0)
    keys = [
        torch.floor((lift(d, c) - origin) / size).view(-1, 3).tolist() for d, c in zip(depths, cameras, strict=True)
    ]
    votes: dict[tuple, dict[int, int]] = {}
    for depth, mask, voxels in zip(depths, labels, keys, strict=True):
        if mask is None:
            continue
        for d, label, voxel in zip(depth.view(-1).tolist(), mask.view(-1).tolist(), voxels, strict=True):
            if d > 0 and label != IGNORE:
                here = votes.setdefault(tuple(voxel), {})
                here[label] = here.get(label, 0) + 1
    pooled = 0
    for depth, mask, voxels, result in zip(depths, labels, keys, results, strict=True):
        old = [IGNORE] * depth.numel() if mask is None else mask.view(-1).tolist()
        found = zip(result.labels.view(-1).tolist(), result.confidence.view(-1).tolist(), strict=True)
        for d, label, voxel, (new, confidence) in zip(depth.view(-1).tolist(), old, voxels, found, strict=True):
            counts = sorted(votes.get(tuple(voxel), {}).items(), key=lambda pair: -pair[1]) if d > 0 else []
            total = sum(count for _, count in counts)
            pooled += total > 2
            assert confidence == pytest.approx(counts[0][1] / total if counts else 0.0)
            clear = counts and (len(counts) == 1 or counts[0][1] > counts[1][1])
            assert new == (counts[0][0] if clear else label)
    assert pooled > 30
    assert calls == [(i, 8) for i in range(1, 9)]


@both
@pytest.mark.parametrize("factor", [1e-4, 1e6])
def test_voxels_scale_with_the_scene(factor):
    depths, cameras, labels = _scene(seed=2)
    scaled = [type(c)(c.viewmat.clone(), c.K, c.width, c.height) for c in cameras]
    for camera in scaled:
        camera.viewmat[:3, 3] *= factor
    before = reproject_voxel(depths, cameras, labels, 3)
    after = reproject_voxel([factor * depth for depth in depths], scaled, labels, 3)
    agree = [(a.labels == b.labels).double().mean() for a, b in zip(before, after, strict=True)]
    assert min(agree) > 0.95  # a point on a voxel's face may round to either side


@both
def test_too_distant_points_neither_vote_nor_change():
    depths, cameras, labels = _scene()
    depths[0][2, 3] = 1e9
    results = reproject_voxel(depths, cameras, labels, 3)
    assert int(results[0].labels[2, 3]) == int(labels[0][2, 3]) and float(results[0].confidence[2, 3]) == 0.0


def test_voxel_is_registered():
    assert REPROJECTIONS.get("voxel") is reproject_voxel
    assert len(SIZES) == 4
