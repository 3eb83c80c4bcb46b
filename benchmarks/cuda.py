"""Times the CUDA backend on a GPU, beside gsplat's 2DGS where it is installed, and prints a table.

    python -m benchmarks.cuda [--quick | --smoke] [--json FILE]

Figures are medians of CUDA events around whole calls, after warming up. See docs/cuda.md.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from beags_plugin.rasterizers.cuda import CudaRasterizer
from beags_plugin.rasterizers.interface import SurfelInputs
from benchmarks.cuda_smoke import LEAVES, smoke
from benchmarks.machine import commit, describe_machine
from benchmarks.scenes import Scene, Size, make_scene, on_device
from benchmarks.training_step import TrainingStep

COUNTS = (100_000, 1_000_000, 4_000_000)
IMAGES = ((832, 608), (1280, 800), (1920, 1088))  # 0.5, 1 and 2 megapixels
LAYERS = 45  # contributing, per pixel: what 50,000 surfels of 17 pixels give 640 x 480
SAMPLES = (1, 10, 20, 50, 100, 1000)  # Z
LEAST_WIDTH = 3.0  # pixels


def case(count: int, width: int, height: int) -> Size:
    """Surfels of such a width that every pixel has about ``LAYERS``, or more where they would be too small."""
    return Size(count, width, height, max(LEAST_WIDTH, 17.0 * (50_000 / (640 * 480) * width * height / count) ** 0.5))


def milliseconds(call: Callable[[], Any], repeats: int, warm: int = 3) -> float:
    """Median time of a call on the GPU."""
    for _ in range(warm):
        call()
    times = []
    for _ in range(repeats):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        call()
        end.record()
        end.synchronize()
        times.append(start.elapsed_time(end))
    return statistics.median(times)


def peak_mb(call: Callable[[], Any]) -> float:
    """Memory that a call takes from torch's allocator beyond what is held before it."""
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    call()
    torch.cuda.synchronize()
    return (torch.cuda.max_memory_allocated() - before) / 2**20


class Drawing:
    """Forward and backward of one backend over one scene, towards all parameters and colours."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        values = {**vars(scene.surfels), "colors": scene.colors}
        self.leaves = {name: values[name].detach().clone().requires_grad_() for name in LEAVES}
        self.settings = replace(scene.settings, distortion=False)
        self.rasterizer = CudaRasterizer()

    def images(self) -> dict[str, Tensor]:
        """What both backends draw: colour, alpha, normal, expected and median depth."""
        drawn = self.rasterizer.rasterize(
            SurfelInputs(**self.leaves), self.scene.camera, self.settings, self.scene.background
        )
        return {name: getattr(drawn, name) for name in ("color", "alpha", "depth", "normal")}

    def both(self) -> None:
        """A forward and a backward from fixed gradients."""
        images = self.images()
        gradients = [self.scene.gradients[name].view_as(image) for name, image in images.items()]
        torch.autograd.grad(list(images.values()), list(self.leaves.values()), gradients, allow_unused=True)


class GsplatDrawing(Drawing):
    """gsplat's ``rasterization_2dgs``: colour with expected depth, alpha and normal."""

    def images(self) -> dict[str, Tensor]:
        from gsplat.rendering import rasterization_2dgs

        p, camera = self.leaves, self.scene.camera
        scales = torch.cat([p["log_scales"].exp(), torch.ones_like(p["log_scales"][:, :1])], dim=1)
        color, alpha, normal, *_ = rasterization_2dgs(
            p["means"], p["quats"], scales, torch.sigmoid(p["opacity_logits"]), p["colors"], camera.viewmat[None],
            camera.K[None], camera.width, camera.height, near_plane=self.settings.near, far_plane=self.settings.far,
            render_mode="RGB+ED", backgrounds=None,
        )  # fmt: skip
        return {"color": color[0, ..., :3], "alpha": alpha[0, ..., 0], "depth": color[0, ..., 3], "normal": normal[0]}


def drawing_row(scene: Scene, drawing: Drawing, name: str, repeats: int) -> dict[str, Any]:
    """How long a backend takes, and its memory."""
    with torch.no_grad():
        forward = milliseconds(drawing.images, repeats)
    both = milliseconds(drawing.both, repeats)
    size = scene.size
    row = {"n": size.n, "width": size.width, "height": size.height, "backend": name, "forward_ms": forward}
    return {**row, "both_ms": both, "peak_mb": peak_mb(drawing.both)}


def gsplat_missing() -> str | None:
    """None if gsplat's CUDA kernels can be used, else why not."""
    try:
        from gsplat.rendering import rasterization_2dgs  # noqa: F401
    except Exception as error:
        return f"gsplat is not there ({error})"
    return None


def copy_rate() -> float:
    """GB/s of a large copy on the device, bytes read and written: the ceiling of what only moves memory."""
    source = torch.rand(1 << 28, device="cuda")
    target = torch.empty_like(source)
    return 2 * source.numel() * 4 / milliseconds(lambda: target.copy_(source), 10) / 1e6


def step_rows(size: Size, repeats: int) -> list[dict[str, Any]]:
    """A training step without and with the two losses; Z from 1 to 1000. A row that fails holds the reason."""
    rows: list[dict[str, Any]] = []
    scene = on_device(make_scene(size), "cuda")
    for samples in (None, *SAMPLES):
        row: dict[str, Any] = {"n": size.n, "width": size.width, "height": size.height, "samples": samples}
        try:
            step = TrainingStep(scene, samples)
            row = {**row, "step_ms": milliseconds(step.run, repeats), "peak_mb": peak_mb(step.run)}
            if samples is not None and "step_ms" in rows[0]:
                row["ratio_to_base"] = row["step_ms"] / rows[0]["step_ms"]
        except Exception as error:
            row["failed"] = failure(error)
        rows.append(row)
        print(row, flush=True)
    return rows


def drawing_rows(size: Size, repeats: int) -> list[dict[str, Any]]:
    """Both backends on one scene; where one fails (no memory, no compiler for gsplat), the reason stands in its row."""
    rows: list[dict[str, Any]] = []
    what = {"n": size.n, "width": size.width, "height": size.height}
    drawings: list[tuple[str, type[Drawing]]] = [("beags", Drawing)]
    if gsplat_missing() is None:
        drawings.append(("gsplat", GsplatDrawing))
    for name, kind in drawings:
        try:
            scene = on_device(make_scene(size), "cuda")
            rows.append(drawing_row(scene, kind(scene), name, repeats))
        except Exception as error:  # of another library too: what is measured already must not be lost
            rows.append({**what, "backend": name, "failed": failure(error)})
        print(rows[-1], flush=True)
    torch.cuda.empty_cache()
    return rows


def failure(error: Exception) -> str:
    """What went wrong, in a line."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def main(arguments: list[str] | None = None) -> int:
    """Run it; exit code 1 without a GPU, where a number is not finite, and where one of our own rows failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the smallest sizes only")
    parser.add_argument("--smoke", action="store_true", help="run every kernel once, time nothing")
    parser.add_argument("--json", help="file to write")
    chosen = parser.parse_args(arguments)
    if reason := CudaRasterizer.unavailable():
        print(f"benchmarks.cuda: {reason}", file=sys.stderr)
        return 1
    if chosen.smoke:
        wrong = smoke(CudaRasterizer())
        torch.cuda.synchronize()
        print("smoke test:", f"not finite: {'; '.join(wrong)}" if wrong else "all is finite")
        return 1 if wrong else 0
    properties = torch.cuda.get_device_properties(0)
    out: dict[str, Any] = {
        "gpu": properties.name,
        "multiprocessors": properties.multi_processor_count,
        "machine": describe_machine(),
        "commit": commit(),
        "torch": torch.__version__,
        "cuda": torch.version.cuda,
        "gsplat": gsplat_missing() or "used",
        "copy_gb_per_s": copy_rate(),
        "rows": [],
        "steps": [],
    }
    print({name: value for name, value in out.items() if name not in ("rows", "steps")}, flush=True)
    repeats = 5 if chosen.quick else 20

    def save() -> None:
        if chosen.json:
            with open(chosen.json, "w") as file:
                json.dump(out, file, indent=1)

    size = case(100_000, *IMAGES[0]) if chosen.quick else case(1_000_000, *IMAGES[1])
    out["steps"] = step_rows(size, repeats)
    save()
    for count in COUNTS[:1] if chosen.quick else COUNTS:
        for width, height in IMAGES[:1] if chosen.quick else IMAGES:
            out["rows"] += drawing_rows(case(count, width, height), repeats)
            save()
    return 1 if any("failed" in row and row.get("backend") != "gsplat" for row in out["rows"] + out["steps"]) else 0


if __name__ == "__main__":
    sys.exit(main())
