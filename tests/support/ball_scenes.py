"""Scenes of three balls over a ground, seen from all sides, with masks and a COLMAP model."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from data_folders import look_at, write_image, write_transforms

VIEWS, SIDE = 12, 48
BALLS = {1: ((-0.6, 0.0, 0.0), 0.4), 2: ((0.6, 0.1, 0.0), 0.4), 3: ((0.0, 0.7, 0.3), 0.3)}
FOCAL = 60.0


def poses() -> list[np.ndarray]:
    """Return camera-to-world matrices [4, 4] on a circle."""
    angles = 2 * np.pi * np.arange(VIEWS) / VIEWS
    return [look_at((4 * np.cos(a), 4 * np.sin(a), 1.5)) for a in angles]


def balls_from(pose: np.ndarray) -> np.ndarray:
    """Return [SIDE, SIDE] uint8 ids of the nearest ball along each pixel's ray."""
    row, column = np.mgrid[:SIDE, :SIDE] + 0.5
    local = np.stack([(column - SIDE / 2) / FOCAL, -(row - SIDE / 2) / FOCAL, -np.ones((SIDE, SIDE))], axis=2)
    rays = local @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    nearest, ids = np.full((SIDE, SIDE), np.inf), np.zeros((SIDE, SIDE), np.uint8)
    for class_id, (center, radius) in BALLS.items():
        to = np.asarray(center) - pose[:3, 3]
        along = rays @ to
        root = along**2 - to @ to + radius**2
        hit = np.where(root > 0, along - np.sqrt(np.maximum(root, 0)), np.inf)
        ids[hit < nearest], nearest = class_id, np.minimum(hit, nearest)
    return ids


def write_balls(root: Path, change=lambda view, ids: ids) -> Path:
    """Write a scene of three balls; ``change`` gives the mask of each view, None for no mask."""
    write_transforms(root, poses=poses(), fl_x=FOCAL, fl_y=FOCAL, cx=SIDE / 2, cy=SIDE / 2, w=SIDE, h=SIDE)
    meta = json.loads((root / "transforms.json").read_text())
    (root / "transforms.json").write_text(json.dumps({**meta, "w": SIDE, "h": SIDE, "fl_x": FOCAL, "fl_y": FOCAL}))
    (root / "classes.json").write_text(json.dumps({"1": "left", "2": "right", "3": "top"}))
    for view, pose in enumerate(poses()):
        write_image(root / f"images/v{view:02d}.png", np.full((SIDE, SIDE, 3), 90, np.uint8))
        if (mask := change(view, balls_from(pose))) is not None:
            write_image(root / f"masks/v{view:02d}.png", mask)
    return root


def write_model(root: Path) -> None:
    """Write a COLMAP model of photos twice as large, in which views show points of the balls and of what is below."""
    generator = np.random.default_rng(0)
    around = generator.normal(size=(3, 400, 3))
    around /= np.linalg.norm(around, axis=2, keepdims=True)
    centers, radii = (np.array([ball[part] for ball in BALLS.values()]) for part in (0, 1))
    on_balls = (centers[:, None] + radii[:, None, None] * around).reshape(-1, 3)
    ground = np.append(generator.uniform(-1.5, 1.5, (1500, 2)), np.full((1500, 1), -0.6), axis=1)
    points, ids = np.concatenate([on_balls, ground]), np.repeat([1, 2, 3, 0], [400, 400, 400, 1500])
    outward = np.concatenate([around.reshape(-1, 3), np.tile([0.0, 0.0, 1.0], (1500, 1))])
    lines = []
    for view, pose in enumerate(poses()):
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        xy = SIDE / 2 + np.array([FOCAL, -FOCAL]) * local[:, :2] / -local[:, 2:]
        faces = ((pose[:3, 3] - points) * outward).sum(1) > 1.0
        inside = faces & (xy >= 0).all(1) & (xy < SIDE).all(1)
        shown = balls_from(pose)
        seen = [p for p in np.flatnonzero(inside) if shown[int(xy[p, 1]), int(xy[p, 0])] == ids[p]]
        lines.append(f"{view + 1} 1 0 0 0 0 0 0 1 photos/v{view:02d}.jpg\n")
        lines.append(" ".join(f"{2 * xy[p, 0]} {2 * xy[p, 1]} {p}" for p in seen) + " 1.0 1.0 -1\n")
    (root / "colmap/sparse/0").mkdir(parents=True)
    (root / "colmap/sparse/0/images.txt").write_text("".join(lines))
    (root / "colmap/sparse/0/cameras.txt").write_text(f"1 PINHOLE {2 * SIDE} {2 * SIDE} 1 1 1 1\n")


def issues(root: Path, **options) -> dict[str, list]:
    """Return what the check finds, by kind."""
    from beags_plugin.objects.check_masks import check_scene, data_options

    found: dict[str, list] = {}
    for issue in check_scene(data_options(root, **options)).issues:
        found.setdefault(issue.kind, []).append(issue)
    return found
