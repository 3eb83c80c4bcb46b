"""A picture of cameras and points from above and from the side."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beags_plugin.system.whole_files import write_whole

_SHOWN = 20_000  # points that are drawn


def draw_poses(path: Path, poses: np.ndarray, points: np.ndarray, colors: np.ndarray, title: str) -> None:
    """Write a .png of cameras [V, 4, 4], which look along -z, and points [P, 3] with colours [P, 3] uint8.

    Up is the mean of the cameras' up axes; points far outside of the cameras' surroundings are cut off.
    """
    from matplotlib.figure import Figure

    up = poses[:, :3, 1].mean(0)
    up /= np.linalg.norm(up) or 1.0
    side = np.linalg.svd(np.eye(3) - np.outer(up, up))[0][:, :2]
    axes = np.stack([side[:, 0], side[:, 1], up], axis=1)
    centers, looks = poses[:, :3, 3] @ axes, -poses[:, :3, 2] @ axes
    chosen = np.random.default_rng(0).permutation(len(points))[:_SHOWN]
    points, colors = points[chosen] @ axes, colors[chosen] / 255.0
    middle = np.median(centers, axis=0)
    reach = 2.0 * float(np.linalg.norm(centers - middle, axis=1).max() or 1.0)
    length = 0.12 * reach
    figure = Figure(figsize=(12, 6.4), layout="constrained")
    figure.suptitle(title, fontsize=10)
    for number, (name, one, other) in enumerate((("from above", 0, 1), ("from the side", 0, 2)), start=1):
        plot = figure.add_subplot(1, 2, number, aspect="equal")
        plot.scatter(points[:, one], points[:, other], s=1, c=colors, linewidths=0)
        for center, look in zip(centers, looks, strict=True):
            plot.plot(*np.stack([center, center + length * look])[:, [one, other]].T, color="tab:red", linewidth=0.8)
        plot.scatter(centers[:, one], centers[:, other], s=9, c="tab:red")
        plot.set(xlim=middle[one] + np.array([-reach, reach]), ylim=middle[other] + np.array([-reach, reach]))
        plot.set(title=name, xticks=[], yticks=[])
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=100))
