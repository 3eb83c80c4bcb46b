"""Random degenerate scenes: the compiled rasterizer and occupancy loss against their references.

    make fuzz COUNT=1000 SEED=0
    python tests/soak/fuzz.py --count 1000 --seed 0 --json fuzz.json      # the same

Scenes are those of ``degenerate.py``: a few surfels, ordinary or spoilt in one way or two, in a world that
may be scaled and shifted, before a camera of a few pixels. What is asked of each, forward and backward:

- nothing raises, in float32 and in float64;
- no output and no gradient is NaN or infinite; surfels with broken numbers are counted and have no gradient;
- in float64 the compiled code agrees with its reference. Where it does not, the reference draws the same scene with its
  numbers changed in their last bits. A scene whose result then jumps as far has no right answer (a hit that lies at a
  threshold, a number that is mostly rounding); it counts as ill-conditioned, not as a failure.

The same seed gives the same scenes. A failure names its scene, which ``--only N`` runs alone. Exit status 1: failures.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from unittest.mock import patch

import torch
from torch import Tensor

sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).resolve().parent)]
from degenerate import FLOATS, Scene, degenerate_scene  # noqa: E402

from beags_plugin.core.surfels import Surfels
from beags_plugin.losses.base import LossInputs
from beags_plugin.losses.occupancy import OccupancyLoss
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.rasterizers import make_rasterizer, torch_reference
from beags_plugin.rasterizers.interface import MIN_TRANSMITTANCE, Rasterizer
from beags_plugin.rasterizers.rendering import draw_features
from beags_plugin.system.progress import progress_bar

OUTPUTS = ("color", "alpha", "depth", "median_depth", "normal", "distortion", "boundary")
# Outputs and gradients in float64 may be off by TOLERANCE, in units of the largest number expected. The unit is at
# least 1, and CANCELLED times the largest output: gradients are sums over 1,000 pixels, in which much of that cancels.
TOLERANCE = 1e-7
CANCELLED = 1e-4
NUDGE = 1e-13  # relative change of every number of a scene, to see how far its own result moves
NUDGE_OF_BOUND = 1e-10  # relative change of the T where compositing stops, a product of differences of near numbers
NUDGES = 12  # an edge-on normal turns over in half of them: all alike is one case in 4,096
FARTHER = 10.0  # the compiled code may differ by this many times what the reference moves by
CHUNK = 25  # scenes that a process is handed at a time


@dataclass
class Finding:
    """Findings in one scene: ``failures`` and ``unclear`` hold sentences, ``spoilt`` the ways in which it is spoilt."""

    scene: int
    failures: list[str] = field(default_factory=list)
    unclear: list[str] = field(default_factory=list)
    spoilt: tuple[str, ...] = ()


def examine(number: int) -> Finding:
    """Run every check on scene ``number``."""
    scene = degenerate_scene(number)
    finding = Finding(number, spoilt=tuple(way for ways in scene.spoilt for way in ways.split("+") if way))
    native, reference = make_rasterizer("native"), make_rasterizer("torch")
    try:
        single = scene.to(torch.float32)
        expected, found = everything(reference, scene), everything(native, scene)
        _clean("native float32", single, everything(native, single), finding)
        _clean("native float64", scene, found, finding)
        _clean("reference", scene, expected, finding)
        _compare(scene, expected, found, nudged_reference, finding)
        expected, found = occupancy(scene, False), occupancy(scene, True)
        _clean("occupancy float32", single, occupancy(single, True), finding)
        _clean("occupancy float64", scene, found, finding)
        _compare(scene, expected, found, lambda nudged, _: occupancy(nudged, False), finding)
    except Exception as error:  # whatever it is, it is a finding: the scene is named and the others go on
        finding.failures.append(f"{type(error).__name__}: {error}")
    return finding


def everything(rasterizer: Rasterizer, scene: Scene) -> dict[str, Tensor]:
    """Return all outputs, channels, their gradients, contributions, pixel counts and class map, by name."""
    leaves = {name: getattr(scene.inputs, name).clone().requires_grad_() for name in FLOATS}
    leaves["background"] = scene.background.clone().requires_grad_()
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(len(scene.inputs.means), 5, generator=generator, dtype=torch.float64)
    leaves["features"] = features.to(scene.inputs.means).requires_grad_()
    inputs = replace(scene.inputs, **{name: leaves[name] for name in FLOATS})
    drawn = rasterizer.rasterize(inputs, scene.camera, scene.settings, leaves["background"], scene.target)
    images = {name: getattr(drawn, name) for name in OUTPUTS if getattr(drawn, name) is not None}
    few = replace(inputs, class_ids=scene.inputs.class_ids % 5)
    images["class channels"] = rasterizer.class_channels(few, scene.camera, scene.settings, 5)
    images["features"] = draw_features(rasterizer, inputs, leaves["features"], scene.camera, scene.settings)
    results = {name: image.detach() for name, image in images.items()}
    loss = sum(
        (image * torch.randn(image.shape, generator=generator, dtype=torch.float64).to(image)).sum()
        for image in images.values()
    )
    if loss.requires_grad:
        loss.backward()
    for name, leaf in leaves.items():
        results[f"gradient of {name}"] = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
    results["broken"] = torch.tensor(drawn.num_nonfinite)
    arguments = (scene.inputs, scene.camera, scene.settings)
    what = (*arguments, scene.target, scene.num_classes)
    for name, (keys, sums) in (
        ("contributions", rasterizer.sparse_class_contributions(*what)),
        ("pixel counts", rasterizer.sparse_class_pixel_counts(*what, 0.1)),
    ):
        surfels, classes = keys // scene.num_classes, keys % scene.num_classes
        for which, values in ((name, sums), (f"{name} by class", sums * torch.cos(classes.to(scene.inputs.means)))):
            zeros = scene.inputs.means.new_zeros(len(scene.inputs.means))
            results[which] = zeros.index_add(0, surfels, values.to(zeros))
    results["share"] = rasterizer.class_map(*arguments, scene.num_classes)[1]
    return results


def nudged_reference(scene: Scene, index: int) -> dict[str, Tensor]:
    """Return ``everything`` of the reference, with the bound of T moved up or down in turn.

    Two surfels whose alpha is cut to 0.99 leave T = 1e-4, which is that bound: rounding alone decides about the second,
    and no change of their numbers shows it.
    """
    bound = MIN_TRANSMITTANCE * (1.0 + (NUDGE_OF_BOUND if index % 2 else -NUDGE_OF_BOUND))
    with patch.object(torch_reference, "MIN_TRANSMITTANCE", bound):
        return everything(make_rasterizer("torch"), scene)


class _PlainGrid(VisibilityGrid):
    """A grid that the compiled code is kept from."""

    def lookup(self):
        return None


def occupancy(scene: Scene, compiled: bool) -> dict[str, Tensor]:
    """Return the occupancy loss and its gradients; voxels are those of the finite centres of every second surfel."""
    inputs, unit = scene.inputs, scene.world[0]
    centres, ids = inputs.means[::2].detach(), inputs.class_ids[::2]
    near = (
        (centres - scene.world[1]).abs().amax(dim=1) < 100 * unit if len(centres) else torch.zeros(0, dtype=torch.bool)
    )
    kind = VisibilityGrid if compiled else _PlainGrid
    cloud = [(centres[near].double(), ids[near])]
    grid = kind.from_points(cloud, 0.1 * unit, torch.full((3,), scene.world[1]), scene.num_classes)
    leaves = {name: getattr(inputs, name).clone().requires_grad_() for name in FLOATS[:4]}
    sh = inputs.colors[:, None]
    surfels = Surfels.of(leaves["means"], leaves["quats"], leaves["log_scales"], leaves["opacity_logits"], sh)
    nothing = None  # drawn: the loss looks at the surfels alone
    given = LossInputs(3, 5, surfels, scene.camera, nothing, nothing, class_ids=inputs.class_ids, grid=grid)  # type: ignore
    value = OccupancyLoss(samples=7).value(given)
    if value.requires_grad:
        value.backward()
    results = {"occupancy": value.detach()}
    for name, leaf in leaves.items():
        results[f"occupancy's gradient of {name}"] = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
    return results


def _clean(what: str, scene: Scene, results: dict[str, Tensor], finding: Finding) -> None:
    """Check that nothing is NaN or infinite, and that broken surfels are counted and learn nothing."""
    finding.failures += [
        f"{what}: {name} is not finite" for name, value in results.items() if not value.isfinite().all()
    ]
    broken = torch.zeros(len(scene.inputs.means), dtype=torch.bool)
    for name in FLOATS:
        broken |= (
            ~getattr(scene.inputs, name).isfinite().flatten(1).all(dim=1)
            if name != "opacity_logits"
            else ~scene.inputs.opacity_logits.isfinite()
        )
    if "broken" in results and int(results["broken"]) < int(broken.sum()):
        finding.failures.append(
            f"{what}: {int(broken.sum())} surfels are broken, {int(results['broken'])} were counted"
        )
    for name in FLOATS:
        gradient = results.get(f"gradient of {name}")
        if gradient is not None and gradient[broken].any():
            finding.failures.append(f"{what}: a broken surfel has a gradient of {name}")


def _compare(scene: Scene, expected, found, again, finding: Finding) -> None:
    """Compare name by name; allow what the reference itself moves by for changes in the last bits."""
    least = max(1.0, CANCELLED * max(_largest(expected[name]) for name in expected if name in (*OUTPUTS, "occupancy")))
    apart = {name: _error(found[name], value, least) for name, value in expected.items()}
    apart = {name: error for name, error in apart.items() if not error <= TOLERANCE}
    if not apart:
        return
    moved = dict.fromkeys(apart, 0.0)
    for index in range(NUDGES):
        nudged = again(_nudged(scene, index), index)
        moved = {name: max(moved[name], _error(nudged[name], expected[name], least)) for name in apart}
        if all(error <= FARTHER * moved[name] for name, error in apart.items()):
            break  # it cannot become a failure any more
    for name, error in apart.items():
        told = f"{name} differs by {error:.2g}, the reference moves by {moved[name]:.2g}"
        (finding.unclear if error <= FARTHER * moved[name] else finding.failures).append(told)


def _error(found: Tensor, expected: Tensor, least: float) -> float:
    """Return the largest difference, in units of the largest number expected, or of ``least``; NaN where any is NaN."""
    if expected.numel() == 0:
        return 0.0
    return float((found.double() - expected.double()).abs().max() / max(_largest(expected), least))


def _largest(values: Tensor) -> float:
    return float(values.double().abs().max()) if values.numel() else 0.0


def _nudged(scene: Scene, index: int) -> Scene:
    generator = torch.Generator().manual_seed(index)

    def moved(value: Tensor) -> Tensor:
        return value * (1.0 + NUDGE * torch.randn(value.shape, generator=generator, dtype=torch.float64))

    floats = {name: moved(getattr(scene.inputs, name)) for name in FLOATS}
    return replace(scene, inputs=replace(scene.inputs, **floats))


def main() -> int:
    """Parse arguments, try the scenes, report; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000, help="how many scenes")
    parser.add_argument("--seed", type=int, default=0, help="number of the first scene")
    parser.add_argument("--only", type=int, default=None, help="try this scene alone and print all about it")
    parser.add_argument("--jobs", type=int, default=max((os.cpu_count() or 2) - 1, 1), help="processes")
    parser.add_argument("--json", type=Path, default=None, help="file for the counts and the failures")
    arguments = parser.parse_args()
    if arguments.only is not None:
        print(degenerate_scene(arguments.only))
        finding = examine(arguments.only)
        print(
            "\n".join([*finding.failures, *(f"ill-conditioned: {told}" for told in finding.unclear)])
            or "nothing is wrong"
        )
        return int(bool(finding.failures))
    start = time.monotonic()
    numbers = range(arguments.seed, arguments.seed + arguments.count)
    failed, unclear, ways = [], 0, Counter()
    with (
        get_context("spawn").Pool(arguments.jobs, torch.set_num_threads, (1,)) as pool,
        progress_bar("Scenes") as progress,
    ):
        for done, finding in enumerate(pool.imap(examine, numbers, chunksize=CHUNK), start=1):
            ways.update(set(finding.spoilt))
            unclear += bool(finding.unclear) and not finding.failures
            if finding.failures:
                failed.append(finding)
                print(
                    f"scene {finding.scene} ({', '.join(finding.spoilt) or 'ordinary'}): {'; '.join(finding.failures)}"
                )
            progress(done, arguments.count)
    print(f"scenes tried: {arguments.count}, failures: {len(failed)}, ill-conditioned: {unclear}")
    if arguments.json:
        report = {
            "scenes": arguments.count, "first": arguments.seed, "failures": len(failed), "ill_conditioned": unclear,
            "seconds": time.monotonic() - start, "scenes_with": dict(ways),
            "failed": [{"scene": one.scene, "spoilt": one.spoilt, "failures": one.failures} for one in failed],
        }  # fmt: skip
        arguments.json.write_text(json.dumps(report, indent=1))
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
