"""Poses found by ``beags process`` against given ones.

    python -m beags_benchmarks.studies.poses DATA OUTPUT [--every N]

Only the photos, without the given poses, go to ``OUTPUT``. The camera centres are aligned by a similarity transform;
then errors of rotation (degrees) and position (share of the largest distance of a camera from the middle) are printed.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from beags_plugin.posing.process import process
from beags_plugin.system.progress import progress_bar
from beags_plugin.system.whole_files import write_text_atomically


def given_poses(data: Path) -> dict[str, np.ndarray]:
    """Return camera-to-world [4, 4], looking along -z, of each photo, by the stem of its file."""
    if (file := data / "transforms.json").is_file():
        frames = json.loads(file.read_text())["frames"]
        return {Path(frame["file_path"]).stem: np.array(frame["transform_matrix"]) for frame in frames}
    import pycolmap

    from beags_plugin.posing.files import camera_to_world

    model = pycolmap.Reconstruction(data / "sparse/0")
    return {Path(model.images[i].name).stem: camera_to_world(model.images[i]) for i in model.reg_image_ids()}


def errors(estimated: dict[str, np.ndarray], reference: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of rotation (degrees) and position (share of the extent) of the photos with both poses."""
    names = sorted(estimated.keys() & reference.keys())
    ours, theirs = (np.stack([poses[name] for name in names]) for poses in (estimated, reference))
    a, b = ours[:, :3, 3], theirs[:, :3, 3]
    middle = b.mean(0)
    u, s, v = np.linalg.svd((b - middle).T @ (a - a.mean(0)))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    turn = u @ sign @ v
    scale = (s * np.diag(sign)).sum() / np.square(a - a.mean(0)).sum()
    moved = scale * (a - a.mean(0)) @ turn.T + middle
    extent = np.linalg.norm(b - middle, axis=1).max()
    residual = np.einsum("ij,njk,nlk->nil", turn, ours[:, :3, :3], theirs[:, :3, :3])
    cosine = np.clip((np.trace(residual, axis1=1, axis2=2) - 1) / 2, -1, 1)
    return np.rad2deg(np.arccos(cosine)), np.linalg.norm(moved - b, axis=1) / extent


def main() -> None:
    """Find poses, compare them, and write the errors and the CPU seconds of each stage to OUTPUT/errors.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--every", type=int, default=1, help="take only every N-th photo")
    options = parser.parse_args()
    data = options.data
    if options.every > 1:
        data = options.output / "chosen"
        data.mkdir(parents=True, exist_ok=True)
        for photo in sorted((options.data / "images").iterdir())[:: options.every]:
            if not (data / photo.name).exists():
                (data / photo.name).symlink_to(photo.resolve())
    began, used = time.monotonic(), time.process_time()
    stages: dict[str, float] = {}

    @contextmanager
    def timed(name: str) -> Iterator[Callable[[int, int], None]]:
        start = time.process_time()
        with progress_bar(name) as progress:
            yield progress
        stages[name] = round(time.process_time() - start, 1)

    report, _ = process(data, options.output, timed)
    frames = json.loads((options.output / "transforms.json").read_text())["frames"]
    poses = {Path(frame["file_path"]).stem: np.array(frame["transform_matrix"]) for frame in frames}
    turned, moved = errors(poses, given_poses(options.data))
    figures = {
        "photos": report.photos,
        "registered": report.registered,
        "reprojection_error": report.reprojection_error,
        "rotation_degrees": float(np.median(turned)),
        "position_percent": 100 * float(np.median(moved)),
        "rotation_largest": float(turned.max()),
        "position_largest": 100 * float(moved.max()),
        "seconds": time.monotonic() - began,
        "processor_seconds": time.process_time() - used,
    }
    write_text_atomically(json.dumps({**figures, "stages": stages}, indent=1) + "\n", options.output / "errors.json")
    rounded = {name: round(value, 3) for name, value in figures.items()}
    print(re.sub(r'[{}"]', "", json.dumps({**rounded, "stages": stages})))


if __name__ == "__main__":
    main()
