"""Memory of the stages before refinement: python -m benchmarks.preparation [REPROJECTION] [VIEWS ...].

Prepares refinement of a generated scene (5,000 Gaussians, 8 classes) for each number of VIEWS (60 240) of 1000 x 750
pixels with REPROJECTION (voxel), in a fresh process each. The masks are as the scene shows them, moved by up to 3
pixels. Prints how much memory the process used at most, how much of it came with the preparation, the seconds,
those of the reprojection with the depth that it lifts, and a digest of all that was prepared.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import time

import torch

WIDTH, HEIGHT = 1000, 750


def measure(reprojection: str, views: int) -> None:
    """Print one JSON line."""
    from beags_plugin.core.cameras import Camera
    from beags_plugin.labels.label_maps import LabelMaps
    from beags_plugin.preparation.pipeline import Preparation, PreparationConfig, prepare
    from beags_plugin.rasterizers import make_rasterizer
    from beags_plugin.rasterizers.rendering import render_class_map
    from beags_plugin.refiners import make_refiner
    from beags_plugin.system.memory import peak_memory_mb
    from benchmarks.peak_memory import peak_mb_of
    from benchmarks.scaling_scene import SETTINGS, Sizes, make_scene

    rasterizer = make_rasterizer("auto")
    scene = make_scene(Sizes(views=views, gaussians=5000, pixels=48), rasterizer)  # its own pictures are not used
    K = torch.tensor([[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1]], dtype=torch.float32)
    cameras = [Camera(camera.viewmat, K, WIDTH, HEIGHT) for camera in scene.cameras]

    def mask(view: int) -> torch.Tensor:
        exact, _ = render_class_map(rasterizer, scene.surfels, scene.class_ids, cameras[view], SETTINGS)
        return exact.roll((view % 7 - 3, view % 5 - 2), (0, 1))

    labels = LabelMaps(mask(view) for view in range(views))
    names = {index: str(index) for index in range(scene.num_classes)}
    config = PreparationConfig(reprojection=reprojection)
    found: list[Preparation] = []
    start, refiner = time.perf_counter(), make_refiner("bea", {})
    added = peak_mb_of(
        lambda: found.append(prepare(scene.surfels, cameras, labels, names, rasterizer, SETTINGS, refiner, config))
    )
    seconds = time.perf_counter() - start
    peak, digest, (prepared,) = peak_memory_mb(), hashlib.sha256(), found
    grid, confidence = prepared.grid, prepared.confidence
    assert grid is not None and confidence is not None
    for values in (*prepared.labels, *confidence, prepared.assignment.class_ids, prepared.assignment.margin, grid.keys):
        digest.update(values.contiguous().numpy().tobytes())
    result = {
        "peak": peak, "added": added, "seconds": seconds, "reprojection": prepared.seconds["reprojection"],
        "voxels": len(grid.keys), "digest": digest.hexdigest(),
    }  # fmt: skip
    print("RESULT" + json.dumps(result))


def main(reprojection: str, counts: list[int]) -> None:
    """Print a line per number of views."""
    for views in counts:
        command = [sys.executable, "-m", "benchmarks.preparation", "--one", reprojection, str(views)]
        text = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
        found = json.loads(text[text.index("RESULT") + 6 :].splitlines()[0])
        print(
            f"{reprojection}, {views} views: peak {found['peak']:.0f} MB, {found['added']:.0f} MB of it by the "
            f"preparation, {found['seconds']:.0f} s, {found['reprojection']:.0f} s of it reprojection, "
            f"{found['voxels']} voxels, digest {found['digest'][:12]}",
            flush=True,
        )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        measure(sys.argv[2], int(sys.argv[3]))
    else:
        main(sys.argv[1] if len(sys.argv) > 1 else "voxel", [int(count) for count in sys.argv[2:]] or [60, 240])
