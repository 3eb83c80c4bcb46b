"""Small scenes whose views vote on each other's labels."""

from __future__ import annotations

import math

import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.masks.reprojection import reproject_pairwise
from beags_plugin.masks.voxel_reprojection import reproject_voxel

SIZES = [(9, 7), (11, 8), (6, 10), (9, 7)]  # width, height


def reprojection_cameras(sizes=SIZES) -> list[Camera]:
    cameras = []
    for index, (width, height) in enumerate(sizes):
        angle = 0.15 * (index - 1.5)
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[0, 0] = viewmat[2, 2] = math.cos(angle)
        viewmat[0, 2], viewmat[2, 0] = math.sin(angle), -math.sin(angle)
        viewmat[:3, 3] = torch.tensor([-3.0 * math.sin(angle), 0.02 * index, 0.1 * index])
        K = torch.tensor([[9.0, 0, width / 2 + 0.3], [0, 8.5, height / 2 - 0.2], [0, 0, 1]], dtype=torch.float64)
        cameras.append(Camera(viewmat, K, width, height))
    return cameras


def reprojection_scene(num_classes: int = 3, seed: int = 0):
    g = torch.Generator().manual_seed(seed)
    cameras, depths, labels = reprojection_cameras(), [], []
    for index, (width, height) in enumerate(SIZES):
        depth = 3.0 + 0.05 * torch.randn(height, width, generator=g, dtype=torch.float64)
        depth[torch.rand(height, width, generator=g) < 0.1] = 0.0
        depths.append(depth)
        mask = torch.randint(0, num_classes, (height, width), generator=g, dtype=torch.int32)
        mask[torch.rand(height, width, generator=g) < 0.1] = IGNORE
        labels.append(None if index == 2 else mask)
    return depths, cameras, labels


METHODS = [reproject_pairwise, reproject_voxel]


def larger_scene(dtype=torch.float32, num_classes: int = 5):
    """Return overlapping views of a slanted wall, with noisy depth, holes and poison, wider than a strip of pixels."""
    sizes = [(71, 23), (90, 31), (64, 40), (71, 23), (83, 29)]
    g = torch.Generator().manual_seed(2)
    cameras, depths, labels = [], [], []
    for index, (camera, (width, height)) in enumerate(zip(reprojection_cameras(sizes), sizes, strict=True)):
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
