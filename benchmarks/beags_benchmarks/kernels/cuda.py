"""Measure the CUDA backend on a GPU, beside gsplat's 2DGS where it is installed.

    python -m beags_benchmarks.kernels.cuda [--quick | --smoke] [--json FILE] [--seconds 500] [--gsplat-seconds 150]

Times are medians of CUDA events around whole calls, after warming up. Rows that do not fit into --seconds are left out
and listed. See notes/speed.md.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import torch
from torch import Tensor

from beags_benchmarks.kernels.cuda_smoke import LEAVES, smoke
from beags_benchmarks.kernels.scenes import Scene, Size, make_scene, on_device
from beags_benchmarks.kernels.training_step import TrainingStep
from beags_benchmarks.provenance import commit, describe_machine
from beags_plugin.rasterizers.cuda import CudaRasterizer
from beags_plugin.rasterizers.interface import SurfelInputs

COUNTS = (100_000, 1_000_000, 4_000_000)
IMAGES = ((832, 608), (1280, 800), (1920, 1088))  # 0.5, 1 and 2 megapixels
LAYERS = 45  # contributing surfels per pixel, as 50,000 surfels of 17 pixels have at 640 x 480
SAMPLES = (1, 10, 20, 50, 100, 1000)  # Z
LEAST_WIDTH = 3.0  # pixels
DEVICE = "cuda"
PARAMETER_BYTES = 52  # float32 of a surfel: mean, quaternion, two scales, opacity, colour
PIXEL_BYTES = 36  # float32 of a pixel: colour, alpha, two depths, normal
# Each pair is written and read at least once: keys and indices before and after the sort, and the record.
PAIR_BYTES = 2 * (2 * 8 + 4 + 80)


def case(count: int, width: int, height: int) -> Size:
    """Return a size whose surfels give every pixel about ``LAYERS``, or more if they would be too small."""
    return Size(count, width, height, max(LEAST_WIDTH, 17.0 * (50_000 / (640 * 480) * width * height / count) ** 0.5))


def milliseconds(call: Callable[[], Any], repeats: int) -> float:
    """Return the median time of a call on the GPU."""
    for _ in range(3):  # the first calls are slower
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
    """Return the peak MB that a call adds to torch's allocator."""
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    call()
    torch.cuda.synchronize()
    return (torch.cuda.max_memory_allocated() - before) / 2**20


class Rendering:
    """Forward and backward of one backend on one scene, with gradients of all parameters and colours."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        values = {**vars(scene.surfels), "colors": scene.colors}
        self.leaves = {name: values[name].detach().clone().requires_grad_() for name in LEAVES}
        self.settings = replace(scene.settings, distortion=False)
        self.rasterizer = CudaRasterizer()

    def images(self) -> dict[str, Tensor]:
        """Return the images of both backends: colour, alpha, normal, expected and median depth."""
        rendered = self.rasterizer.rasterize(
            SurfelInputs(**self.leaves), self.scene.camera, self.settings, self.scene.background
        )
        return {name: getattr(rendered, name) for name in ("color", "alpha", "depth", "normal")}

    def both(self) -> None:
        """Run a forward and a backward from fixed gradients."""
        images = self.images()
        gradients = [self.scene.gradients[name].view_as(image) for name, image in images.items()]
        torch.autograd.grad(list(images.values()), list(self.leaves.values()), gradients, allow_unused=True)


class GsplatRendering(Rendering):
    """gsplat's ``rasterization_2dgs``: colour with expected depth, alpha, normal, and normals of that depth."""

    mode: Literal["RGB", "RGB+ED"] = "RGB+ED"

    def images(self) -> dict[str, Tensor]:
        from gsplat.rendering import rasterization_2dgs

        p, camera = self.leaves, self.scene.camera
        scales = torch.cat([p["log_scales"].exp(), torch.ones_like(p["log_scales"][:, :1])], dim=1)
        color, alpha, normal, *_ = rasterization_2dgs(
            p["means"], p["quats"], scales, torch.sigmoid(p["opacity_logits"]), p["colors"], camera.viewmat[None],
            camera.K[None], camera.width, camera.height, near_plane=self.settings.near, far_plane=self.settings.far,
            render_mode=self.mode, backgrounds=None,
        )  # fmt: skip
        images = {"color": color[0, ..., :3], "alpha": alpha[0, ..., 0], "normal": normal[0]}
        return images | ({"depth": color[0, ..., 3]} if self.mode == "RGB+ED" else {})


class GsplatWithoutDepth(GsplatRendering):
    """gsplat without depth; it renders less than the others."""

    mode = "RGB"


BACKENDS = (("beags", Rendering), ("gsplat", GsplatRendering), ("gsplat RGB", GsplatWithoutDepth))


def rendering_row(scene: Scene, rendering: Rendering, name: str, repeats: int) -> dict[str, Any]:
    """Return the times and the memory of a backend."""
    with torch.no_grad():
        forward = milliseconds(rendering.images, repeats)
    both = milliseconds(rendering.both, repeats)
    size = scene.size
    row = {**size_of(size), "backend": name, "forward_ms": forward, "both_ms": both, "peak_mb": peak_mb(rendering.both)}
    if name == "beags":
        row["pairs"] = rendering.rasterizer.pairs()
        row["least_mb"] = least_bytes(size, rendering.rasterizer.pairs()) / 2**20
    return row


def size_of(size: Size) -> dict[str, Any]:
    """Return the entries that identify a row."""
    return {"n": size.n, "width": size.width, "height": size.height}


def least_bytes(size: Size, pairs: int) -> int:
    """Return the least number of bytes that forward and backward move.

    Parameters are read twice and their gradients written once; images are written and their gradients read; each pair
    of a tile and a surfel adds ``PAIR_BYTES``.
    """
    return 3 * PARAMETER_BYTES * size.n + 2 * PIXEL_BYTES * size.width * size.height + PAIR_BYTES * pairs


def against_the_copy_rate(rows: list[dict[str, Any]], rate: float) -> None:
    """Add to our rows the time of ``least_mb`` at the rate of a copy (GB/s), and its share of the row's time."""
    for row in rows:
        if "least_mb" in row:
            row["least_ms"] = row["least_mb"] * 2**20 / (rate * 1e6)
            row["share_of_copy_rate"] = row["least_ms"] / row["both_ms"]


PROBE = "from gsplat.rendering import rasterization_2dgs; from gsplat.cuda._backend import _C; assert _C is not None"


def gsplat_missing(seconds: float) -> str | None:
    """Return None if gsplat's CUDA kernels can be used, else the reason.

    gsplat compiles them on its first import, which may take many minutes; a separate process limits this to
    ``seconds``.
    """
    if seconds <= 0:
        return "left out: --gsplat-seconds is 0"
    try:
        done = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, timeout=seconds)
    except subprocess.TimeoutExpired:
        return f"gsplat did not compile its kernels within {seconds:.0f} s"
    if done.returncode == 0:
        return None
    lines = done.stderr.strip().splitlines()
    return f"gsplat cannot be used: {lines[-1] if lines else f'exit code {done.returncode}'}"


def copy_rate() -> float:
    """Return the GB/s, read and written, of a large copy on the device: the limit of memory transfer."""
    source = torch.rand(1 << 28, device=DEVICE)
    target = torch.empty_like(source)
    return 2 * source.numel() * 4 / milliseconds(lambda: target.copy_(source), 10) / 1e6


def step_rows(size: Size, repeats: int) -> list[dict[str, Any]]:
    """Measure a training step without and with the two losses, Z from 1 to 1000; a failed row has the reason."""
    rows: list[dict[str, Any]] = []
    scene: Scene | None = None
    for samples in (None, *SAMPLES):
        row: dict[str, Any] = {**size_of(size), "samples": samples}
        try:
            scene = scene or on_device(make_scene(size), DEVICE)
            step = TrainingStep(scene, samples)
            row = {**row, "step_ms": milliseconds(step.run, repeats), "peak_mb": peak_mb(step.run)}
            if rows and "step_ms" in rows[0]:
                row["ratio_to_base"] = row["step_ms"] / rows[0]["step_ms"]
                row["extra_ms"] = row["step_ms"] - rows[0]["step_ms"]
        except Exception as error:
            row["failed"] = failure(error)
        rows.append(row)
        print(row, flush=True)
    return rows


def rendering_rows(size: Size, repeats: int, gsplat: bool) -> list[dict[str, Any]]:
    """Measure both backends on one scene; a failed row (out of memory, for example) has the reason."""
    rows: list[dict[str, Any]] = []
    scene: Scene | None = None
    for name, kind in BACKENDS[: None if gsplat else 1]:
        try:
            scene = scene or on_device(make_scene(size), DEVICE)
            rows.append(rendering_row(scene, kind(scene), name, repeats))
        except Exception as error:  # Whatever another library raises, earlier rows must not be lost.
            rows.append({**size_of(size), "backend": name, "failed": failure(error)})
        print(rows[-1], flush=True)
        torch.cuda.empty_cache()
    return rows


def failure(error: Exception) -> str:
    """Return the error in one line."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; return exit code 1 without a GPU, for numbers that are not finite, or if our rows fail."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the smallest sizes only")
    parser.add_argument("--smoke", action="store_true", help="run every kernel once, time nothing")
    parser.add_argument("--json", help="file to write, again after every row")
    parser.add_argument("--seconds", type=float, default=500.0, help="start no new row after this time")
    parser.add_argument("--gsplat-seconds", type=float, default=150.0, help="for gsplat to compile; 0 leaves it out")
    chosen, began = parser.parse_args(arguments), time.monotonic()
    if reason := CudaRasterizer.unavailable():
        print(f"beags_benchmarks.kernels.cuda: {reason}", file=sys.stderr)
        return 1
    if chosen.smoke:
        wrong = smoke(CudaRasterizer())
        torch.cuda.synchronize()
        print("smoke test:", f"not finite: {'; '.join(wrong)}" if wrong else "all is finite")
        return 1 if wrong else 0
    return measure(describe_gpu(), chosen, began + chosen.seconds)


def describe_gpu() -> dict[str, Any]:
    """Return the machine and the versions of a measurement."""
    properties = torch.cuda.get_device_properties(0)
    names = ("multi_processor_count", "total_memory", "L2_cache_size", "clock_rate", "memory_clock_rate")
    return {
        "gpu": properties.name,
        "capability": f"{properties.major}.{properties.minor}",
        **{name: getattr(properties, name) for name in names if hasattr(properties, name)},
        "machine": describe_machine(),
        "commit": commit(),
        "torch": torch.__version__,
        "cuda": torch.version.cuda,
    }


def measure(machine: dict[str, Any], chosen: argparse.Namespace, end: float) -> int:
    """Measure the rows that can begin before ``end`` (of ``time.monotonic``); returns the exit code."""
    missing = gsplat_missing(chosen.gsplat_seconds)
    out: dict[str, Any] = {**machine, "gsplat": missing or "used", "copy_gb_per_s": copy_rate(), "left_out": []}
    print(out, flush=True)
    out.update(rows=[], steps=[])
    repeats = 5 if chosen.quick else 20

    def save() -> None:
        against_the_copy_rate(out["rows"], out["copy_gb_per_s"])
        if chosen.json:
            with open(chosen.json, "w") as file:
                json.dump(out, file, indent=1)

    out["steps"] = step_rows(case(100_000, *IMAGES[0]) if chosen.quick else case(1_000_000, *IMAGES[1]), repeats)
    save()
    sizes = [case(count, *image) for count in COUNTS for image in IMAGES]
    for size in sizes[:1] if chosen.quick else sizes:
        if time.monotonic() > end:
            out["left_out"].append(size_of(size))
            continue
        out["rows"] += rendering_rows(size, repeats, gsplat=missing is None)
        save()
    save()
    print(table(out), flush=True)
    ours = [row for row in out["rows"] + out["steps"] if not row.get("backend", "").startswith("gsplat")]
    return 1 if any("failed" in row for row in ours) else 0


def table(out: dict[str, Any]) -> str:
    """Return the rows as text."""
    lines = [f"{out.get('gpu')}, a copy moves {out['copy_gb_per_s']:.0f} GB/s, gsplat: {out['gsplat']}"]
    lines.append("surfels    image        backend    forward   both ms   MB   of copy rate")
    for row in out["rows"]:
        name = f"{row['n']:<10} {row['width']}x{row['height']:<7} {row['backend']:<10}"
        if "failed" in row:
            lines.append(f"{name} failed: {row['failed']}")
            continue
        share = f"{100 * row['share_of_copy_rate']:.0f} %" if "share_of_copy_rate" in row else ""
        lines.append(f"{name} {row['forward_ms']:7.2f} {row['both_ms']:9.2f} {row['peak_mb']:6.0f}  {share}")
    lines.append("step       Z        ms     MB   times the base step")
    for row in out["steps"]:
        name = f"{row['n']:<10} {row['samples'] or 'base'!s:<5}"
        if "failed" in row:
            lines.append(f"{name} failed: {row['failed']}")
            continue
        lines.append(f"{name} {row['step_ms']:7.2f} {row['peak_mb']:6.0f}  {row.get('ratio_to_base', 1.0):.3f}")
    lines += [f"left out, no time: {size}" for size in out["left_out"]]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
