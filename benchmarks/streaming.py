"""Memory and waiting of views kept in memory and of views streamed: python -m benchmarks.streaming [VIEWS].

Writes VIEWS (300) photos of 1000 x 750 with masks to a temporary folder, then takes batches as training does, in a
fresh process per way, with 60 ms of other work a step. Prints how much memory each process used at most, how long a
step waited for its batch, and whether all batches were the same, bit for bit.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

WIDTH, HEIGHT, STEPS, WORK_SECONDS = 1000, 750, 100, 0.06


def write_views(root: Path, views: int) -> None:
    """Write a ring of cameras, photos of smooth noise, which JPEG codes like photographs, and masks of rectangles."""
    import cv2

    generator = np.random.default_rng(0)
    for name in ("images", "masks"):
        (root / name).mkdir()
    frames = []
    for view in range(views):
        coarse = generator.integers(0, 256, (HEIGHT // 12, WIDTH // 12, 3), dtype=np.uint8)
        image = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        image = cv2.add(image, generator.integers(0, 24, image.shape, dtype=np.uint8))
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[200:500, 100 + view : 400 + view] = 1 + view % 5
        cv2.imwrite(str(root / f"images/v{view:03d}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 92])
        cv2.imwrite(str(root / f"masks/v{view:03d}.png"), mask)
        angle = 2 * np.pi * view / views
        c, s = np.cos(angle), np.sin(angle)
        pose = [[-s, 0, c, 3 * c], [c, 0, s, 3 * s], [0, 1, 0, 0], [0, 0, 0, 1]]
        frames.append({"file_path": f"images/v{view:03d}.jpg", "transform_matrix": pose})
    lens = {"fl_x": 900, "fl_y": 900, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    (root / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", **lens, "frames": frames}))


def take_batches(root: Path, stream: str) -> None:
    """Print one JSON line: peak memory before and after, waiting, digest of the batches."""
    import hashlib

    from beags_plugin.plugin.views.datamanager import BeagsDataManagerConfig
    from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
    from beags_plugin.system.memory import peak_memory_mb

    parser = BeagsDataParserConfig(data=root, num_random_points=1000)
    config = BeagsDataManagerConfig(dataparser=parser, stream=stream, cache_images_type="uint8")
    manager = config.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    before, digest, waits = peak_memory_mb(), hashlib.sha256(), []
    start = time.perf_counter()
    for step in range(STEPS):
        asked = time.perf_counter()
        camera, batch = manager.next_train(step)
        waits.append(time.perf_counter() - asked)
        for part in (batch["image"], batch["labels"], camera.get_intrinsics_matrices()):
            digest.update(part.numpy().tobytes())
        until = time.thread_time() + WORK_SECONDS
        while time.thread_time() < until:
            np.dot(np.ones(1000), np.ones(1000))
    found = {"before": before, "peak": peak_memory_mb(), "first": waits[0], "wait": float(np.median(waits[1:]))}
    found |= {"seconds": time.perf_counter() - start, "digest": digest.hexdigest(), "streams": manager.streams("train")}
    print("RESULT" + json.dumps(found))


def main(views: int) -> None:
    """Measure both ways, and print the automatic choice."""
    with tempfile.TemporaryDirectory() as folder:
        write_views(Path(folder), views)
        found = {}
        for stream in ("never", "always", "auto"):
            command = [sys.executable, "-m", "benchmarks.streaming", folder, stream]
            text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            found[stream] = json.loads(text[text.index("RESULT") + 6 :].splitlines()[0])
            own = found[stream]
            more = own["peak"] - own["before"]
            print(f"{stream:7s} streams: {own['streams']}, peak {own['peak']:.0f} MB, {more:.0f} MB of it for views")
            waits = f"first batch after {own['first']:.2f} s, later ones {1000 * own['wait']:.1f} ms"
            print(f"        {waits}, {STEPS} steps {own['seconds']:.1f} s", flush=True)
    print("batches equal, bit for bit:", len({own["digest"] for own in found.values()}) == 1)


if __name__ == "__main__":
    if len(sys.argv) == 3:
        take_batches(Path(sys.argv[1]), sys.argv[2])
    else:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 300)
