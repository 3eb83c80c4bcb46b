"""Measure the pictures per second of nerfstudio's viewer while the camera moves, by a client without a browser.

    python -m beags_benchmarks.studies.viewer [--load-config CONFIG] [--gaussians N] [--seconds 10] [--isolate] [--cut]

It measures twice: with the picture sizes that nerfstudio chooses, and with ours. With --cut, objects are picked without
a pause meanwhile, as in the tab Pick.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import socket
import statistics
import sys
import tempfile
import threading
import time
from collections import defaultdict
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, cast

from beags_benchmarks.kernels.scenes import Size, make_scene
from beags_benchmarks.provenance import busy_note, describe_machine

MOVES_PER_SECOND = 50  # most messages that viser's page sends
SETTLING = 4.0  # seconds of motion before pictures count
WORLD = 10.0  # viser's units per unit of nerfstudio


def move_and_count(port: int, middle: list[float], seconds: float, heights: Any) -> None:
    """Move a camera to and fro around ``middle``, seen from the origin; put the height of each picture on a queue."""
    import msgspec
    import numpy as np
    from PIL import Image
    from viser.transforms import SO3
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    connection = connect(f"ws://127.0.0.1:{port}", max_size=None, compression=None)
    begin = time.monotonic()

    def move() -> None:
        while (spent := time.monotonic() - begin) < SETTLING + seconds:
            away = -SO3.from_z_radians(0.2 * math.sin(2.0 * spent)).apply(np.array(middle))
            forward = -away / np.linalg.norm(away)
            right = np.cross(forward, [0.0, 0.0, 1.0])
            right /= np.linalg.norm(right)
            rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
            message = {
                "type": "ViewerCameraMessage", "wxyz": SO3.from_matrix(rotation).wxyz.tolist(),
                "position": (WORLD * (away + middle)).tolist(), "fov": 1.0, "aspect": 1.25,
                "look_at": [WORLD * value for value in middle], "up_direction": [0.0, 0.0, 1.0],
            }  # fmt: skip
            connection.send(msgspec.msgpack.encode(message))
            time.sleep(1 / MOVES_PER_SECOND)
        connection.close()

    threading.Thread(target=move, daemon=True).start()
    with suppress(ConnectionClosed):
        for raw in connection:
            content = msgspec.msgpack.decode(cast(bytes, raw))
            for message in content if isinstance(content, list) else [content]:
                if message["type"] == "BackgroundImageMessage" and time.monotonic() - begin > SETTLING:
                    heights.put(Image.open(BytesIO(message["rgb_bytes"])).size[1])
    heights.put(None)


def write_run_of(count: int, root: Path) -> Path:
    """Write a run of a synthetic scene, seen from the origin along y; return its config.yml."""
    import torch
    from PIL import Image

    from beags_plugin.plugin.options.config import base_config
    from beags_plugin.runs.write import write_run

    scene = make_scene(Size(count, 640, 480, 13.0))
    surfels = scene.surfels
    pose = [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
    (root / "images").mkdir(parents=True)
    names = [f"images/{index}.png" for index in range(2)]
    for name in names:
        Image.new("RGB", (64, 48)).save(root / name)
    frames = [{"file_path": name, "transform_matrix": pose} for name in names]
    views = {"fl_x": 58, "fl_y": 58, "cx": 32, "cy": 24, "w": 64, "h": 48, "frames": frames}
    (root / "transforms.json").write_text(json.dumps({**views, "train_filenames": names, "val_filenames": names}))
    config = base_config()
    parser: Any = config.data_config.dataparser
    parser.data, parser.orientation_method, parser.center_method = root, "none", "none"
    parser.auto_scale_poses, parser.scale_factor = False, 1.0
    state = {
        # The means turn from a camera's axes to z up; the discs have random slants anyway.
        "gauss_params.means": surfels.means[:, [0, 2, 1]] * torch.tensor([1.0, 1.0, -1.0]),
        "gauss_params.quats": surfels.quats, "gauss_params.scales": surfels.log_scales,
        "gauss_params.opacities": surfels.opacity_logits[:, None], "gauss_params.features_dc": surfels.sh_dc,
        "gauss_params.features_rest": surfels.sh_rest, "class_ids": scene.class_ids,
        "class_margin": torch.ones(count), "assigned": torch.tensor(True), "extent": torch.tensor(4.0),
        "refined_steps": torch.tensor(0), "_extra_state": {"classes": dict(enumerate(("background", *"abc")))},
    }  # fmt: skip
    return write_run(config, root / "run", state, 99)


class Stages:
    """Records the seconds spent in wrapped functions."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    def time(self, name: str, owner: Any, attribute: str) -> None:
        function = getattr(owner, attribute)

        def call(*args, **kwargs):
            begin = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.seconds[name] += time.perf_counter() - begin

        setattr(owner, attribute, call)


def measure(viewer: Any, port: int, middle: list[float], seconds: float, ours: bool, stages: Stages) -> float:
    """Move for a while, print the received pictures, and return their number per second."""
    from beags_plugin.plugin.viewer.pace import Pace

    viewer.pipeline.model.viewing.pace = Pace()
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    context.Process(target=move_and_count, args=(port, middle, seconds, queue), daemon=True).start()
    while not viewer.render_statemachines:
        time.sleep(0.05)
    time.sleep(0.2)
    for machine in viewer.render_statemachines.values() if not ours else ():
        machine.__dict__.pop("_calculate_image_res", None)
    queue.get()
    stages.seconds.clear()
    begin, heights = time.perf_counter(), []
    processor = time.process_time()
    while (height := queue.get()) is not None:
        heights.append(height)
    wall, count = time.perf_counter() - begin, len(heights)
    processor = time.process_time() - processor
    print(
        f"{'ours' if ours else 'nerfstudio'}: {count / wall:.1f} pictures/s, height {statistics.median(heights):.0f} "
        f"({min(heights)} to {max(heights)}); {1e3 * processor / count:.0f} ms of processor time a picture"
    )
    print("   " + ", ".join(f"{name} {1e3 * value / count:.1f} ms" for name, value in stages.seconds.items()))
    while viewer.render_statemachines:
        time.sleep(0.05)
    return count / wall


def cut_on(viewing: Any, seconds: list[float]) -> None:
    """Cut an object out of the shown scene repeatedly, in a thread, and show it in colour like the tab Pick.

    One mark lies on it, another beside it. seconds: receives the time of each cut.
    """
    import torch

    from beags_plugin.picking.cutter import Cutter, ViewMarks
    from beags_plugin.plugin.viewer.picking import camera_along
    from beags_plugin.plugin.viewer.viewing import Paint

    model, surfels = viewing.model, viewing.whole()[0]
    middle = surfels.means.median(dim=0).values
    views = [camera_along([0.0, 0.0, 0.0], middle.tolist(), 480, 400.0)]
    began = time.perf_counter()
    cutter = Cutter(surfels, views, model.rasterizer, model.settings())
    print(f"made once in {time.perf_counter() - began:.1f} s")
    far = surfels.means[(surfels.means - middle).norm(dim=1).argmax()]
    places = ((middle, True), (far, False))
    numbers = torch.zeros(7, 7, dtype=torch.int32)
    marks = [
        ViewMarks("view", camera_along([0.0, 0.0, 0.0], place.tolist(), 7, 600.0), numbers, (inside,))
        for place, inside in places
    ]
    colors = surfels.means.new_tensor([1.0, 0.5, 0.0]).expand(len(surfels), 3)

    def cut() -> None:
        members = cutter.solve(marks).to(colors.device)
        viewing.paint = Paint(colors, 0.65 * members.float(), None)

    cut()  # a first cut in this thread shows errors

    def work() -> None:
        while True:
            began = time.perf_counter()
            cut()
            seconds.append(time.perf_counter() - began)

    threading.Thread(target=work, daemon=True).start()


def main() -> None:
    """Measure and print the rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--load-config", type=Path, help="a run instead of the synthetic scene")
    parser.add_argument("--gaussians", type=int, default=84_000, help="of the synthetic scene")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each measurement")
    parser.add_argument("--isolate", action="store_true", help="show one object alone")
    parser.add_argument("--cut", action="store_true", help="pick objects meanwhile")
    options = parser.parse_args()
    from nerfstudio.utils.eval_utils import eval_setup  # must come first: nerfstudio's imports are circular otherwise

    # isort: split
    from nerfstudio.utils import writer
    from nerfstudio.viewer.render_state_machine import RenderStateMachine
    from nerfstudio.viewer.viewer import Viewer
    from viser import SceneApi

    from beags_plugin.plugin.viewer import viewing

    with tempfile.TemporaryDirectory() as folder, socket.socket() as probe:
        config_path = options.load_config or write_run_of(options.gaussians, Path(folder))
        config, pipeline, _, _ = eval_setup(config_path, test_mode="test")
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
        probe.close()
        config.viewer.websocket_port, config.viewer.websocket_host = port, "127.0.0.1"
        config.logging.local_writer.enable = False
        viewer = Viewer(config.viewer, Path(folder) / "log", Path(folder), pipeline, None, threading.Lock())
        writer.setup_local_writer(config.logging, max_iter=config.max_num_iterations)
        stages, model = Stages(), cast(Any, pipeline.model)
        stages.time("nerfstudio's rendering", RenderStateMachine, "_render_img")
        stages.time("of it the model", model, "get_outputs")
        stages.time("of it choosing", model.viewing, "shown")
        stages.time("colours", viewing, "surfel_inputs")
        stages.time("rasterizer", model.rasterizer, "rasterize")
        stages.time("sending", RenderStateMachine, "_send_output_to_viewer")
        stages.time("of it encoding", SceneApi, "set_background_image")
        if options.isolate:
            model.viewing.choice = model.viewing.choice.isolate(1)
        machine = describe_machine()
        print(f"{len(model.means):,} Gaussians; {machine}; {busy_note(int(machine['cores'])) or 'nothing else runs'}")
        cuts: list[float] = []
        if options.cut:
            cut_on(model.viewing, cuts)
        middle = model.means.detach().median(dim=0).values.tolist()
        rates = [measure(viewer, port, middle, options.seconds, ours, stages) for ours in (False, True)]
        if cuts:
            print(f"{len(cuts)} cuts meanwhile, {statistics.median(cuts):.2f} s each")
        print(f"ours over nerfstudio's: {rates[1] / rates[0]:.2f}")
        sys.stdout.flush()
    os._exit(0)  # see the viewer's panel


if __name__ == "__main__":
    main()
