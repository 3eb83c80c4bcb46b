"""Voxel votes chunk by chunk: the same bits, with few voxels in memory at a time."""

from __future__ import annotations

import math

import pytest
import torch
from voted_views import larger_scene, same

from beags_plugin.masks import spatial_chunks as chunks
from beags_plugin.masks import voxel_reprojection
from beags_plugin.masks.pooled_votes import lift
from beags_plugin.masks.spatial_chunks import WHOLE, divide_space, torch_brick_sample
from beags_plugin.masks.voxel_reprojection import _to_voxels, reproject_voxel
from beags_plugin.ops import extension
from beags_plugin.ops.voxel_votes import brick_sample


@pytest.mark.usefixtures("ops")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_number_of_chunks_gives_the_same_bits(monkeypatch, dtype):
    scene = larger_scene(dtype)
    whole, cut, reported = list(reproject_voxel(*scene)), [], []

    def observed(*args):
        cut.append(divide_space(*args))
        return cut[-1]

    monkeypatch.setattr(voxel_reprojection, "divide_space", observed)
    monkeypatch.setattr(chunks, "_PART", 2)  # there are few bricks
    for most in (10**6, 60, 12):
        monkeypatch.setattr(chunks, "MOST_BRICKS", most)
        assert same(list(reproject_voxel(*scene, progress=lambda *now: reported.append(now))), whole)
        assert reported[-1] == (10 * len(cut[-1]), 10 * len(cut[-1])) and len(reported) == reported[-1][1]
        reported.clear()
    counts = [len(each) for each in cut]
    assert counts[0] == 1 and 1 < counts[1] < counts[2]


def test_chunks_hold_about_as_many_bricks_as_they_may():
    """The chunks are compared with a count of all bricks."""
    g = torch.Generator().manual_seed(0)
    cameras = larger_scene()[1][:1] * 4
    height, width = cameras[0].height, cameras[0].width
    depths = [0.5 + 40.0 * torch.rand(height, width, generator=g) for _ in cameras]
    lifts = _to_voxels(cameras, torch.zeros(3, dtype=torch.float64), 0.02)
    lifted = [lift(depth, own.to(depth)) for depth, own in zip(depths, lifts, strict=True)]
    bricks = torch.unique(torch.cat([torch.floor(p[near] / 4) for p, _, near in lifted]), dim=0)
    assert len(bricks) > 5000  # nearly every pixel has its own: the worst case
    assert divide_space(depths, cameras, lifts, most=10**4) is WHOLE
    found = divide_space(depths, cameras, lifts, most=1500)
    assert abs(len(found) - len(bricks) / 1500) < 2
    assert (found.axis, found.borders[0], found.borders[-1]) == (2, -math.inf, math.inf)  # depth is the longest
    in_chunk = torch.bucketize(bricks[:, 2].contiguous(), torch.tensor(found.borders[1:-1]) / 4, right=True)
    sizes = torch.bincount(in_chunk, minlength=len(found))
    assert len(sizes) == len(found) and int(sizes.max()) < 2 * 1500


@pytest.mark.skipif(extension.load() is None, reason="beags_plugin._native was not built")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_compiled_sample_of_bricks_is_that_of_torch(dtype):
    depths, cameras, *_ = larger_scene(dtype)
    depth = depths[0].clone()
    depth[:4] = torch.tensor([0.0, math.nan, math.inf, 1e30], dtype=dtype)[:, None]  # these lift no point
    to_voxels = _to_voxels(cameras, torch.zeros(3, dtype=torch.float64), 0.01)[0].to(dtype)
    every = torch_brick_sample(depth, to_voxels, 1)
    assert len(every) > 100 and torch.equal(brick_sample(depth, to_voxels, 1), every)
    some = torch_brick_sample(depth, to_voxels, 4)
    assert 0 < len(some) < len(every) / 2 and torch.equal(brick_sample(depth, to_voxels, 4), some)


def test_each_point_is_in_one_chunk_and_what_matters_to_it_is_about():
    cut = chunks.SpatialChunks(0, (-math.inf, -4.0, 8.0, math.inf), 5.0)
    coordinates = torch.tensor([-1e6, -4.0, -4.001, 7.9, 8.0, math.nan])
    inside = torch.stack([cut.inside(coordinates, chunk) for chunk in range(3)])
    assert inside.int().argmax(0)[:5].tolist() == [0, 1, 0, 1, 2] and inside.sum(0).tolist() == [1] * 5 + [0]
    assert cut.about(torch.tensor([-9.1, -9.0, 12.9, 13.0]), 1).tolist() == [False, True, True, False]
