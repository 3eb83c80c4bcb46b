"""Memory of a whole training: python -m benchmarks.whole_run [VIEWS] [ns-train's flags ...].

Writes VIEWS (300) photos of 1000 x 750 of a generated scene (5,000 Gaussians, 8 classes) to a temporary folder, with
masks that are moved by up to 3 pixels, and runs ``ns-train beags`` on it as it stands but for its length: 40 base and
40 refinement steps. It starts from the scene's own Gaussians, so that depth and masks are those of a trained base.
Every 8th view is held out; images are streamed, masks reprojected, classes assigned, Gaussians split at borders, grids
built, held-out views measured. Prints the most memory that the process used and the seconds of each stage.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from beags_plugin.system.child_processes import bound

WIDTH, HEIGHT, STEPS = 1000, 750, 40


def write_data(root: Path, views: int) -> None:
    """Write <root>/data with photos, masks and poses, and <root>/scene.ply with the scene of the photos."""
    import cv2

    from beags_plugin.core.cameras import Camera
    from beags_plugin.rasterizers import make_rasterizer
    from beags_plugin.rasterizers.rendering import render_class_map, surfel_inputs
    from beags_plugin.splat_io.ply import write_ply
    from benchmarks.scaling_scene import SETTINGS, Sizes, make_scene

    rasterizer = make_rasterizer("auto")
    scene = make_scene(Sizes(views=views, gaussians=5000, pixels=48), rasterizer)  # its own pictures are not used
    K = torch.tensor([[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1]], dtype=torch.float32)
    for name in ("images", "masks"):
        (root / "data" / name).mkdir(parents=True)
    frames = []
    for view, small in enumerate(scene.cameras):
        camera, name = Camera(small.viewmat, K, WIDTH, HEIGHT), f"v{view:03d}"
        with torch.no_grad():
            inputs = surfel_inputs(scene.surfels, camera)
            color = rasterizer.rasterize(inputs, camera, SETTINGS, torch.zeros(3)).color.clamp(0, 1)
            ids, _ = render_class_map(rasterizer, scene.surfels, scene.class_ids, camera, SETTINGS)
        ids = ids.roll((view % 7 - 3, view % 5 - 2), (0, 1))
        photo = (255 * color).round().to(torch.uint8).numpy()[..., ::-1]
        cv2.imwrite(str(root / f"data/images/{name}.jpg"), photo, [cv2.IMWRITE_JPEG_QUALITY, 92])
        cv2.imwrite(str(root / f"data/masks/{name}.png"), ids.to(torch.uint8).numpy())
        pose = np.linalg.inv(camera.viewmat.double().numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/{name}.jpg", "transform_matrix": pose.tolist()})
    lens = {"fl_x": WIDTH, "fl_y": WIDTH, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    (root / "data/transforms.json").write_text(json.dumps({"camera_model": "OPENCV", **lens, "frames": frames}))
    write_ply(root / "scene.ply", scene.surfels)


def main(views: int, flags: list[str]) -> None:
    """Write the data in a process of its own, train, print."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        subprocess.run([sys.executable, "-m", "benchmarks.whole_run", "--write", folder, str(views)], check=True)
        command = [
            sys.executable, "-c", "from nerfstudio.scripts.train import entrypoint; entrypoint()", "beags",
            "--data", str(root / "data"), "--run-dir", str(root / "run"), "--vis", "tensorboard",
            "--machine.device-type", "cpu", "--pipeline.model.start-from", str(root / "scene.ply"),
            "--pipeline.model.base-steps", str(STEPS), "--pipeline.model.refine-steps", str(STEPS), *flags,
        ]  # fmt: skip
        start = time.perf_counter()
        process = subprocess.Popen(bound(command))
        _, status, used = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - start
        if status != 0:
            raise SystemExit(f"ns-train ended with {os.waitstatus_to_exitcode(status)}")
        report = json.loads((root / "run/training.json").read_text())
        stages = json.loads((root / "run/prepared/report.json").read_text())
        print(f"{views} views of {WIDTH} x {HEIGHT}: peak {used.ru_maxrss * 1024 / 1e6:.0f} MB, {seconds:.0f} s")
        print(f"by the end of the preparation {stages['peak_memory_mb']:.0f} MB")
        print("seconds of the preparation:", {name: round(value) for name, value in stages["seconds"].items()})
        print("seconds of the run:", {name: round(value) for name, value in report["seconds"].items()})
        print("found:", *stages["summary"], sep="\n  ")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--write"]:
        write_data(Path(sys.argv[2]), int(sys.argv[3]))
    else:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 300, sys.argv[2:])
