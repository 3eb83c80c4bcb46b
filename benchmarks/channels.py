"""python -m benchmarks.channels: time of channels in one pass, by threes and by class beside an image of colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
import tyro
from rich.console import Console
from torch import Tensor

from beags_plugin.bench.report import plain_table
from beags_plugin.rasterizers.interface import Rasterizer, SurfelInputs
from beags_plugin.rasterizers.native import NativeRasterizer
from beags_plugin.rasterizers.rendering import draw_features
from benchmarks.clock import Seconds
from benchmarks.machine import commit, describe_machine
from benchmarks.scenes import Scene, make_scene, parse_size


@dataclass(frozen=True)
class ChannelOptions:
    """Time of F channels, forward and backward, over that of one image of colours, on one thread.

    sizes: N/WIDTHxHEIGHT. channels: numbers F. rounds: in which everything has its turn; the least CPU time counts.
    """

    sizes: tuple[str, ...] = ("20k/320x240", "50k/320x240")
    channels: tuple[int, ...] = (3, 9, 16, 64)
    rounds: int = 7


class ByThrees(NativeRasterizer):
    """Three channels at a time."""

    feature_channels = Rasterizer.feature_channels


def run_channels(options: ChannelOptions) -> dict[str, dict[str, float]]:
    """Measure and print a table; returns CPU seconds by size and what was drawn."""
    torch.set_num_threads(1)
    found = {}
    for name in options.sizes:
        ways = _ways(make_scene(parse_size(name)), options.channels)
        found[name] = dict.fromkeys(ways, float("inf"))
        for _ in range(options.rounds):
            for label, way in ways.items():
                start = Seconds.now()
                way()
                found[name][label] = min(found[name][label], (Seconds.now() - start).cpu)
    rows = [
        (name, label, f"{1e3 * seconds:.1f}", f"{seconds / least['colours']:.2f}")
        for name, least in found.items()
        for label, seconds in least.items()
    ]
    console = Console(soft_wrap=True, highlight=False)
    console.print(f"{describe_machine()['cpu']}; torch {torch.__version__}; commit {commit()}")
    console.print(plain_table("Channels, forward and backward", ("size", "drawn", "CPU ms", "over colours"), rows))
    return found


def _ways(scene: Scene, channels: tuple[int, ...]) -> dict[str, Callable[[], object]]:
    """Return what is timed by name: a drawing and its gradients, towards geometry and features or features alone."""
    g, rasterizer, ways = torch.Generator().manual_seed(0), NativeRasterizer(), {}
    s, settings = scene.surfels, replace(scene.settings, geometry=False, distortion=False)
    geometry = [value.clone().requires_grad_() for value in (s.means, s.quats, s.log_scales, s.opacity_logits)]
    means, quats, log_scales, opacity_logits = geometry
    inputs = SurfelInputs(means, quats, log_scales, opacity_logits, scene.colors.clone().requires_grad_())
    what = (scene.camera, settings)

    def add(name: str, leaves: list[Tensor], gradient: Tensor, draw: Callable[..., Tensor], *arguments: object) -> None:
        ways[name] = lambda: torch.autograd.grad(draw(*arguments), leaves, gradient)

    def colors() -> Tensor:
        return rasterizer.rasterize(inputs, *what, scene.background).color

    add("colours", [*geometry, inputs.colors], scene.gradients["color"], colors)
    for count in channels:
        features = torch.rand(len(s), count, generator=g).requires_grad_()
        gradient = torch.randn(scene.camera.height, scene.camera.width, count, generator=g)
        for way, backend in (("by threes", ByThrees()), ("in one pass", rasterizer)):
            if backend is rasterizer and count <= 3:
                continue  # that is a pass of three
            drawing = (gradient, draw_features, backend)
            add(f"{count} channels {way}", [*geometry, features], *drawing, inputs, features, *what)
            alone = f"{count} channels {way}, features' gradients alone"
            add(alone, [features], *drawing, inputs.detached(), features, *what)
        ids = torch.randint(0, count, (len(s),), generator=g, dtype=torch.int32)  # every tile has nearly all of them
        labelled = replace(inputs, class_ids=ids)
        add(f"{count} class channels", geometry, gradient, rasterizer.class_channels, labelled, *what, count)
    return ways


if __name__ == "__main__":
    run_channels(tyro.cli(ChannelOptions))
