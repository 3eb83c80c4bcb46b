"""python -m benchmarks.reprojection: time and accuracy of the reprojections against the number of views."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.console import Console
from torch import Tensor

from beags_plugin.bench.report import (
    new_figure,
    number,
    plain_table,
    provenance,
    save_figure,
    write_csv,
    write_json,
)
from beags_plugin.core.cameras import Camera
from beags_plugin.evaluation.metrics import mask_metrics, mean_metrics
from beags_plugin.masks import REPROJECTIONS
from beags_plugin.system.errors import UserError, print_user_errors_plainly
from beags_plugin.system.reading.arrays import load_array

CONSOLE = Console(soft_wrap=True, highlight=False, markup=False)  # paths may hold brackets
DEPTHS = ("trained", "exact")
REFERENCE = "pairwise"  # what the others are compared with
AS_GIVEN = "masks as given"


@dataclass(frozen=True)
class ReprojectionOptions:
    """Time and accuracy of the mask reprojections against the number of views, on the sample.

    views: numbers of training views; a base is trained for each. depths: what is lifted, the trained base's depth or
    the sample's exact one. methods: names of reprojections; the others are compared with pairwise. preset: its base
    phase is trained. seed, width, height: of the sample, in pixels. calls: how often each is timed; the least counts.
    output: folder of scenes, bases and results. json, csv, picture: files; <output>/reprojection.json and so on if
    left out.
    """

    views: tuple[int, ...] = (30, 60, 120, 240)
    depths: tuple[str, ...] = DEPTHS
    methods: tuple[str, ...] = ("pairwise", "voxel")
    preset: str = "beags-tiny"
    seed: int = 0
    width: int = 256
    height: int = 192
    calls: int = 3
    output: Path = Path("outputs/bench")
    json: Path | None = None
    csv: Path | None = None
    picture: Path | None = None

    def check(self) -> None:
        """Raise ``UserError`` for a value that cannot be measured."""
        for depth in self.depths:
            if depth not in DEPTHS:
                raise UserError(f"there is no depth {depth!r} to lift: choose of {', '.join(DEPTHS)}.")
        for method in self.methods:
            REPROJECTIONS.get(method)
        if not self.views or min(self.views) < 1 or self.calls < 1:
            raise UserError("--views and --calls must be 1 or more.")


@dataclass(frozen=True)
class VotedScene:
    """Training views of a sample.

    cameras: V. labels: V x [H, W] int32 as given, None for views without a mask. exact: V x [H, W] int32, the truth.
    depths: kind to V x [H, W] float32, world units along z. num_classes: the background included.
    """

    cameras: Sequence[Camera]
    labels: Sequence[Tensor | None]
    exact: Sequence[Tensor]
    depths: Mapping[str, Sequence[Tensor]]
    num_classes: int


@dataclass(frozen=True)
class MethodRow:
    """One method on one scene.

    seconds, cpu_seconds: least of all calls. iou, biou: against the exact masks, mean over views and objects; equal:
    share of the pixels with the label that ``REFERENCE`` gives them; wrong: with another one than the exact. In 0..1.
    """

    views: int
    depth: str
    method: str
    seconds: float | None
    cpu_seconds: float | None
    iou: float
    biou: float
    wrong: float
    equal: float | None


def run_reprojection(options: ReprojectionOptions) -> list[MethodRow]:
    """Make samples, train a base for each, measure, print a table and write the files; returns the rows."""
    options.check()
    rows = []
    for views in options.views:
        scene = load_views(options, views)
        for depth in options.depths:
            rows += measure(scene, depth, options.methods, options.calls)
    table = [cells(row, rows) for row in rows]
    CONSOLE.print(plain_table("Reprojection", _COLUMNS, table))
    content = {"experiment": "reprojection", "options": plain(options), **provenance()}
    content |= {"threads": torch.get_num_threads(), "rows": [asdict(row) for row in rows]}
    files = {kind: getattr(options, kind) or options.output / f"reprojection.{end}" for kind, end in _FILES}
    write_json(files["json"], content)
    write_csv(files["csv"], [asdict(row) for row in rows])
    plot_quality(files["picture"], rows)
    for kind, path in files.items():
        CONSOLE.print(f"{kind}: {path}")
    return rows


_FILES = (("json", "json"), ("csv", "csv"), ("picture", "png"))
_COLUMNS = ("views, depth", "method", "wall, s", "CPU, s", "times as fast", "IoU, %", "BIoU, %", "wrong, %", "equal, %")


def plain(options: Any) -> dict[str, Any]:
    """Return the options as JSON holds them, without the paths."""
    return {name: value for name, value in asdict(options).items() if not isinstance(value, Path | None)}


def load_views(options: ReprojectionOptions, views: int) -> VotedScene:
    """Return the sample with this number of training views, and the depth of a base trained on it."""
    from beags_plugin.labels.classes import read_id_mask
    from beags_plugin.rasterizers import make_rasterizer
    from beags_plugin.rasterizers.rendering import geometry_inputs, surface_depth
    from beags_plugin.runs.read import raster_settings, read_run, read_transform
    from beags_plugin.sample.writer import make_sample
    from benchmarks.bases import trained_base

    name = f"sample-{options.seed}-{options.width}x{options.height}-{views}"
    data = options.output / "scenes" / name
    make_sample(data, options.seed, options.width, options.height, "mild", views)
    config = trained_base(data, options.output / "bases" / f"{name}-{options.preset}", options.preset)
    scene = read_run(config)
    manager = scene.config.data_config.setup(device="cpu", test_mode="test", world_size=1, local_rank=0)
    found = manager.views("train")
    truth = manager.train_dataset.metadata["ground_truth"]
    exact = [torch.from_numpy(read_id_mask(path).astype(np.int32)) for path in truth["masks"]]
    transform = read_transform(config.parent)
    factor = 1.0 if transform is None else transform[1]  # from the sample's units to those of the run
    of_sample = [torch.from_numpy(factor * load_array(data / f"ground_truth/depth/{view.name}.npy")) for view in found]
    rasterizer = make_rasterizer(scene.config.model_config.rasterizer)
    settings, surfels = raster_settings(scene), geometry_inputs(scene.surfels())
    kind = scene.config.model_config.prepare.depth
    with torch.no_grad():
        trained = [
            surface_depth(rasterizer.rasterize(surfels, view.camera, settings, torch.zeros(3)), kind) for view in found
        ]
    depths = {"trained": trained, "exact": of_sample}
    return VotedScene(
        [view.camera for view in found], [view.labels for view in found], exact, depths, len(scene.classes)
    )


def measure(scene: VotedScene, depth: str, methods: Sequence[str], calls: int) -> list[MethodRow]:
    """Measure the masks as they are, then each method; the methods take turns, ``calls`` times each."""
    depths = scene.depths[depth]
    views = len(scene.cameras)
    blank = [torch.zeros_like(mask) for mask in scene.exact]  # a view without a mask shows no object
    given = [zeros if mask is None else mask for mask, zeros in zip(scene.labels, blank, strict=True)]
    rows = [MethodRow(views, depth, AS_GIVEN, None, None, *quality(given, scene.exact, scene.num_classes), None)]
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in methods}
    labels: dict[str, list[Tensor]] = {}
    for _ in range(calls):
        for name in methods:
            reproject = REPROJECTIONS.get(name)
            wall, cpu = time.perf_counter(), time.process_time()
            masks = list(reproject(depths, scene.cameras, scene.labels, scene.num_classes))
            times[name].append((time.perf_counter() - wall, time.process_time() - cpu))
            labels[name] = [mask.labels for mask in masks]
    for name in methods:
        wall, cpu = min(t[0] for t in times[name]), min(t[1] for t in times[name])
        equal = same_share(labels[name], labels[REFERENCE]) if REFERENCE in labels else None
        rows.append(
            MethodRow(views, depth, name, wall, cpu, *quality(labels[name], scene.exact, scene.num_classes), equal)
        )
    return rows


def quality(found: Sequence[Tensor], exact: Sequence[Tensor], num_classes: int) -> tuple[float, float, float]:
    """IoU and BIoU, mean over views and objects, and the share of pixels with a wrong label (no label is wrong)."""
    metrics = mean_metrics(
        mask_metrics(a == class_id, b == class_id)
        for a, b in zip(found, exact, strict=True)
        for class_id in range(1, num_classes)
    )
    assert metrics is not None and metrics.iou is not None and metrics.biou is not None  # empty masks count
    return metrics.iou, metrics.biou, 1.0 - same_share(found, exact)


def same_share(a: Sequence[Tensor], b: Sequence[Tensor]) -> float:
    """Share of the pixels of all views with equal labels."""
    equal = sum(int((x == y).sum()) for x, y in zip(a, b, strict=True))
    return equal / sum(x.numel() for x in a)


def cells(row: MethodRow, rows: Sequence[MethodRow]) -> list[str]:
    """Return a line of the table."""
    place = (row.views, row.depth)
    reference = next((r for r in rows if (r.views, r.depth) == place and r.method == REFERENCE), None)
    faster = None
    if reference is not None and row.cpu_seconds and reference.cpu_seconds:
        faster = reference.cpu_seconds / row.cpu_seconds
    first = f"{row.views}, {row.depth}" if row.method == AS_GIVEN else ""
    shares = (row.iou, row.biou, row.wrong, row.equal)
    return [
        first, row.method, number(row.seconds, 2), number(row.cpu_seconds, 2), number(faster, 1),
        *(number(None if share is None else 100 * share, 2) for share in shares),
    ]  # fmt: skip


def plot_quality(path: Path, rows: Sequence[MethodRow]) -> None:
    """Plot time, IoU and BIoU over views, a line for each method and depth."""
    figure, axes = new_figure(3)
    shown = (("cpu_seconds", "CPU seconds", 1.0), ("iou", "IoU, %", 100.0), ("biou", "BIoU, %", 100.0))
    for axis, (name, title, factor) in zip(axes[0], shown, strict=True):
        for depth, style in zip(DEPTHS, ("o-", "s--"), strict=True):
            for color, method in enumerate(dict.fromkeys(row.method for row in rows)):
                line = [row for row in rows if row.depth == depth and row.method == method]
                known = [(row.views, factor * value) for row in line if (value := getattr(row, name)) is not None]
                if known and (method != AS_GIVEN or depth == DEPTHS[0]):
                    label = method if method == AS_GIVEN else f"{method}, {depth} depth"
                    axis.plot(*zip(*known, strict=True), style, color=f"C{color}", label=label)
        axis.set_xscale("log")
        axis.set_xticks(sorted({row.views for row in rows}), sorted({row.views for row in rows}))
        axis.minorticks_off()
        axis.set_xlabel("views")
        axis.set_title(title)
    axes[0][0].set_yscale("log")
    axes[0][0].legend(fontsize="small")
    save_figure(path, figure)


if __name__ == "__main__":
    print_user_errors_plainly()
    run_reprojection(tyro.cli(ReprojectionOptions))
