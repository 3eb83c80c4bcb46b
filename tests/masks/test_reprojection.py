"""Reprojection (E5) against loops over views and pixels."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from voted_views import reprojection_cameras, reprojection_scene

import beags_plugin.masks.reprojection as reprojection
from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.masks.reprojection import reproject_pairwise
from beags_plugin.system.errors import UserError

both = pytest.mark.usefixtures("ops")  # run with the torch versions and with the compiled ops


def _by_loops(depths, cameras, labels, num_classes, tau):
    """E5, pixel by pixel in numpy."""
    results = []
    for i, target in enumerate(cameras):
        votes = np.zeros((target.height, target.width, num_classes), dtype=int)
        for j, source in enumerate(cameras):
            if labels[j] is None:
                continue
            to_world = np.linalg.inv(source.viewmat.numpy())
            for y in range(source.height):
                for x in range(source.width):
                    d, label = depths[j][y, x].item(), labels[j][y, x].item()
                    if d <= 0 or label == IGNORE:
                        continue
                    ray = np.linalg.inv(source.K.numpy()) @ np.array([x + 0.5, y + 0.5, 1.0])
                    world = to_world @ np.append(d * ray, 1.0)
                    px, py, z = target.K.numpy() @ (target.viewmat.numpy() @ world)[:3]
                    if z <= 0 or not (0 <= px / z < target.width and 0 <= py / z < target.height):
                        continue
                    column, row = int(px / z), int(py / z)
                    if abs(z - depths[i][row, column].item()) <= tau * z:
                        votes[row, column, label] += 1
        old = labels[i].numpy() if labels[i] is not None else np.full((target.height, target.width), IGNORE)
        new, confidence = old.copy(), np.zeros(old.shape, dtype=np.float32)
        for row in range(target.height):
            for column in range(target.width):
                here = votes[row, column]
                if here.sum():
                    confidence[row, column] = here.max() / here.sum()
                    if (here == here.max()).sum() == 1:
                        new[row, column] = here.argmax()
        results.append((new, confidence))
    return results


@both
@pytest.mark.parametrize("tau", [0.02, 0.05, math.inf])
@pytest.mark.parametrize("dense", [True, False])
def test_equals_loops(monkeypatch, tau, dense):
    if not dense:
        monkeypatch.setattr(reprojection, "_DENSE_COUNTERS", 0)
    depths, cameras, labels = reprojection_scene()
    calls = []
    results = list(reproject_pairwise(depths, cameras, labels, 3, tau=tau, progress=lambda *state: calls.append(state)))
    for result, (expected, confidence) in zip(results, _by_loops(depths, cameras, labels, 3, tau), strict=True):
        assert result.labels.dtype == torch.int32 and result.confidence.dtype == torch.float32
        assert np.array_equal(result.labels.numpy(), expected)
        assert np.allclose(result.confidence.numpy(), confidence)
    assert calls == [(i, 4) for i in (1, 2, 3, 4)]
    assert (results[2].labels != IGNORE).any()  # the view without a mask got one


def test_chunks_do_not_matter(monkeypatch):
    depths, cameras, labels = reprojection_scene(seed=1)
    whole = list(reproject_pairwise(depths, cameras, labels, 3))
    monkeypatch.setattr(reprojection, "_CHUNK_PIXELS", 1)
    for a, b in zip(whole, reproject_pairwise(depths, cameras, labels, 3), strict=True):
        assert torch.equal(a.labels, b.labels) and torch.equal(a.confidence, b.confidence)


@both
def test_one_view_votes_for_itself():
    depths, cameras, labels = reprojection_scene()
    (result,) = reproject_pairwise(depths[:1], cameras[:1], labels[:1], 3)
    assert torch.equal(result.labels, labels[0])
    voted = (labels[0] != IGNORE) & (depths[0] > 0)
    assert torch.equal(result.confidence, voted.float())


def _copies(masks, depth=2.0):
    """The same camera several times: every pixel gets exactly the votes of ``masks``."""
    camera = reprojection_cameras([(1, 1)])[0]
    labels = [None if m is None else torch.tensor([[m]], dtype=torch.int32) for m in masks]
    depths = [torch.full((1, 1), depth, dtype=torch.float64)] * len(masks)
    return [(int(r.labels), float(r.confidence)) for r in reproject_pairwise(depths, [camera] * len(masks), labels, 4)]


@both
def test_majority_tie_and_silence():
    assert _copies([1, 1, 3]) == [(1, pytest.approx(2 / 3))] * 3
    assert _copies([1, 3, IGNORE, None]) == [(1, 0.5), (3, 0.5), (IGNORE, 0.5), (IGNORE, 0.5)]  # a tie changes nothing
    assert _copies([None, IGNORE]) == [(IGNORE, 0.0)] * 2
    assert _copies([2, 1], depth=0.0) == [(2, 0.0), (1, 0.0)]
    assert _copies([0, None]) == [(0, 1.0)] * 2  # the background is a class like others


@both
def test_hidden_points_do_not_vote():
    """Camera 1 stands behind the wall that camera 0 sees, and sees something nearer itself."""
    camera = reprojection_cameras([(1, 1)])[0]
    depths = [torch.tensor([[2.0]]), torch.tensor([[1.0]])]
    labels = [torch.tensor([[1]], dtype=torch.int32), None]
    assert int(list(reproject_pairwise(depths, [camera] * 2, labels, 2))[1].labels) == IGNORE
    assert int(list(reproject_pairwise(depths, [camera] * 2, labels, 2, tau=math.inf))[1].labels) == 1


@both
@pytest.mark.parametrize("factor", [1e-4, 1e6])
def test_scale_of_the_scene_does_not_matter(factor):
    depths, cameras, labels = reprojection_scene(seed=2)
    scaled = []
    for camera in cameras:
        viewmat = camera.viewmat.clone()
        viewmat[:3, 3] *= factor
        scaled.append(Camera(viewmat, camera.K, camera.width, camera.height))
    before = list(reproject_pairwise(depths, cameras, labels, 3))
    after = list(reproject_pairwise([factor * depth for depth in depths], scaled, labels, 3))
    assert all(torch.equal(a.labels, b.labels) for a, b in zip(before, after, strict=True))


@both
def test_depths_that_are_not_finite_do_not_vote():
    depths, cameras, labels = reprojection_scene()
    for value in (math.nan, math.inf, -1.0):
        spoilt = [depth.clone() for depth in depths]
        cleared = [depth.clone() for depth in depths]
        spoilt[0][2, 3], cleared[0][2, 3] = value, 0.0
        a, b = (list(reproject_pairwise(d, cameras, labels, 3, tau=0.5)) for d in (spoilt, cleared))
        assert all(torch.equal(x.labels, y.labels) for x, y in zip(a, b, strict=True))


def test_mistakes_are_refused():
    depths, cameras, labels = reprojection_scene()
    with pytest.raises(UserError, match="view 0 holds class ids 0..2"):
        list(reproject_pairwise(depths, cameras, labels, 2))
    with pytest.raises(UserError, match="view 1 is 8 x 11"):
        list(reproject_pairwise(depths, cameras, [None, labels[1].T, None, None], 3))
    with pytest.raises(UserError, match="tau"):
        list(reproject_pairwise(depths, cameras, labels, 3, tau=-1.0))
