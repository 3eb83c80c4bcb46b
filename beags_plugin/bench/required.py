"""``beags bench required``: what a trained scene stores and computes for nothing, and what leaving it out saves."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import torch
from rich.console import Console
from torch import Tensor

from beags_plugin.assignment.assignment import assign_classes
from beags_plugin.bench.report import number, plain_table, provenance, write_csv, write_json
from beags_plugin.bench.run import TABLE_WIDTH
from beags_plugin.core.sh_resolution import seen_shares, with_degree
from beags_plugin.core.surfels import Surfels
from beags_plugin.errors import UserError
from beags_plugin.evaluation.metrics import psnr
from beags_plugin.masks.label_maps import narrowed, widened
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.sampling import sample_stream
from beags_plugin.progress import progress_bar
from beags_plugin.rasterizers.drawing import surfel_inputs
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.refiners.fewer_bands import changes_of_fewer_bands

if TYPE_CHECKING:
    from beags_plugin.plugin.datamanager import BeagsDataManager, View
    from beags_plugin.plugin.extract import SavedScene

CONSOLE = Console(soft_wrap=True, highlight=False, markup=False)  # paths may hold brackets
PIXELS = (0.25, 0.5, 1.0, 2.0, 4.0)  # what a Gaussian must fill in some view to be kept
CALLS = 5  # of which the median counts; both sides take turns


@dataclass(frozen=True)
class Row:
    """One thing that may not be needed.

    whole, needed: how much there is of it and how much is left, in ``unit``. seconds_whole, seconds_needed: of what
    ``timed`` names, with all and with what is left. difference: what the result loses, in ``measure``; 0.0 where it is
    the same bit for bit.
    """

    what: str
    unit: str
    whole: float
    needed: float
    timed: str = ""
    seconds_whole: float | None = None
    seconds_needed: float | None = None
    measure: str = ""
    difference: float | None = None


@dataclass(frozen=True)
class Scene:
    """A run as it is measured: the base that refinement started from, its views, and the refined surfels and grid.

    Of a base without classes, ``refined`` is the base itself, and ``class_ids`` and ``grid`` are None.
    """

    base: Surfels
    refined: Surfels
    class_ids: Tensor | None
    grid: VisibilityGrid | None
    train: Sequence[View]
    test: Sequence[View]
    num_classes: int
    rasterizer: Rasterizer
    settings: RasterSettings
    samples: int


def run_required(config: Path, json: Path | None = None, csv: Path | None = None) -> list[Row]:
    """Measure a run, print a table and write the files that are asked for; returns the rows.

    Of a base without classes, what does not take any is measured.

    config: config.yml of the run. Raises ``UserError`` if it is none, or holds no refinement.
    """
    scene = load(config)
    rows: list[Row] = []
    parts: tuple[Callable[[Scene], list[Row]], ...] = (gaussians, bands, samples, voxels, class_maps, images)
    with progress_bar("Measuring") as progress:
        for index, part in enumerate(parts):
            rows += part(scene)
            progress(index + 1, len(parts))
    wide = Console(width=max(CONSOLE.width, TABLE_WIDTH), highlight=False, markup=False)
    wide.print(plain_table(f"What {config.parent} needs", _COLUMNS, [cells(row) for row in rows]))
    lines = [asdict(row) for row in rows]
    if json:
        write_json(json, {"experiment": "required", "threads": torch.get_num_threads(), **provenance(), "rows": lines})
    if csv:
        write_csv(csv, lines)
    return rows


def load(config: Path) -> Scene:
    """Read the run, its data and what its preparation kept."""
    from beags_plugin.plugin.evaluate import EvaluatedRun
    from beags_plugin.plugin.runs import last_prepared

    run = EvaluatedRun(config)
    after: SavedScene = run.stages["after"]
    if "before" not in run.stages and after.class_ids is not None:
        raise UserError(f"{config.parent} keeps no base beside its scene: name a run of beags that was refined.")
    before: SavedScene = run.stages.get("before", after)
    kept = last_prepared(config.parent) / "grid.pt"
    state = torch.load(kept, weights_only=True) if kept.exists() else {}
    manager: BeagsDataManager = after.config.data_config.setup(
        device="cpu", test_mode="test", world_size=1, local_rank=0
    )
    occupancy = after.config.model_config.losses["occupancy"]
    return Scene(
        before.surfels(),
        after.surfels(),
        after.class_ids,
        VisibilityGrid.from_state_dict(state) if state else None,
        manager.views("train"),
        manager.views("test"),
        max(after.classes) + 1,
        run.rasterizer,
        run.settings,
        int(occupancy.options.get("samples", 20)),
    )


def gaussians(scene: Scene) -> list[Row]:
    """Gaussians that fill less than so many pixels in every training view, removed from the base."""
    cameras = [view.camera for view in scene.train]
    found = assign_classes(scene.base, cameras, [None] * len(cameras), scene.rasterizer, scene.settings, 1)
    rows = []
    for least in (0.0, *PIXELS):
        kept = scene.base[found.strongest > 0 if least == 0 else found.strongest >= least]
        times, pictures = in_turn(lambda: draw(scene, scene.base), lambda part=kept: draw(scene, part))
        loss = mean_psnr(pictures[0], scene.test) - mean_psnr(pictures[1], scene.test)
        name = "Gaussians that no training view shows" if least == 0 else f"Gaussians below {least:g} px in every view"
        rows.append(
            Row(
                name,
                "Gaussians",
                len(scene.base),
                len(kept),
                "drawing held-out views",
                *times,
                measure="PSNR, dB",
                difference=loss,
            )
        )
    return rows


def bands(scene: Scene) -> list[Row]:
    """Coefficients of the colour that no view tells apart, and what the base loses with fewer bands."""
    surfels, cameras = scene.base, [view.camera for view in scene.train]
    degree = surfels.sh_degree
    share, degrees = seen_shares(surfels.means, cameras, degree)
    count = surfels.sh.numel()
    rows = [Row("coefficients of the colour that no view tells apart", "coefficients", count, share * count)]
    for band in range(1, degree + 1):
        told = float(degrees[band + 1 :].sum()) * len(surfels)
        rows.append(Row(f"Gaussians whose views do not resolve degree {band}", "Gaussians", len(surfels), told))
    whole = [mean_psnr(draw(scene, surfels, views), views) for views in (scene.train, scene.test)]
    found = changes_of_fewer_bands(surfels, cameras, scene.rasterizer, scene.settings)
    for band, (fewer, change) in enumerate(found):
        times, _ = in_turn(lambda: draw(scene, surfels), lambda part=fewer: draw(scene, part))
        bare = with_degree(surfels, [], band)  # the bands left out, nothing in their stead
        losses = {
            "training views": whole[0] - mean_psnr(draw(scene, fewer, scene.train), scene.train),
            "held-out views": whole[1] - mean_psnr(draw(scene, fewer), scene.test),
            "training views, nothing in their stead": whole[0] - mean_psnr(draw(scene, bare, scene.train), scene.train),
        }
        size = 4.0 * fewer.sh.numel()
        named = f"bands above degree {band}, RMS change {change:.5f}"
        for where, loss in losses.items():
            row = Row(f"{named}: {where}", "bytes", 4.0 * count, size, measure="PSNR, dB", difference=loss)
            timed = {"timed": "drawing held-out views", "seconds_whole": times[0], "seconds_needed": times[1]}
            rows.append(replace(row, **timed) if where == "held-out views" else row)
    return rows


def samples(scene: Scene) -> list[Row]:
    """Occupancy samples in discs that wholly lie in valid voxels."""
    from beags_plugin.ops import extension

    lookup = None if scene.grid is None else scene.grid.lookup()
    if scene.grid is None or lookup is None or scene.class_ids is None:
        return []
    surfels = scene.refined
    parameters = [surfels.means, surfels.quats, surfels.log_scales, surfels.opacity_logits]
    parameters = [value.contiguous() for value in parameters]
    compute = extension.function("occupancy_loss", surfels.means)
    background = bool((scene.grid.classes == 0).any())
    ranks, stream = lookup.ranks(scene.class_ids), sample_stream(0, 1)

    def run(skip: bool) -> tuple[float, int, list[Tensor]]:
        out = [torch.empty_like(value) for value in parameters]
        value, active = compute(
            *parameters, ranks, lookup.native, stream, scene.samples, background, *out, extension.threads(), skip=skip
        )
        return value, active, out

    times, ((value, every, gradients), (same, active, others)) = in_turn(lambda: run(False), lambda: run(True))
    largest = max(float((a - b).abs().max()) for a, b in zip(gradients, others, strict=True))
    largest = max(largest, abs(value - same) if abs(value - same) > 1e-12 * abs(value) else 0.0)  # sums round
    return [
        Row(
            "occupancy samples in discs that are wholly valid", "samples", scene.samples * every,
            scene.samples * active, "loss and gradients", *times, measure="value or gradient", difference=largest,
        )
    ]  # fmt: skip


def voxels(scene: Scene) -> list[Row]:
    """Voxels of the background where only objects are asked about, and of classes without Gaussians."""
    if scene.grid is None or scene.class_ids is None or not bool((scene.grid.classes == 0).any()):
        return []
    asked = torch.unique(scene.class_ids)
    part = scene.grid.only(asked[asked != 0])
    objects = scene.class_ids != 0
    points, ids = scene.refined.means[objects], scene.class_ids[objects]
    differ = float((part.valid(points, ids) != scene.grid.valid(points, ids)).float().mean())
    whole, needed = (_bytes(grid) for grid in (scene.grid, part))
    return [Row("voxels of the background", "bytes", whole, needed, measure="share of look-ups", difference=differ)]


def class_maps(scene: Scene) -> list[Row]:
    """Class maps in 4 bytes, as kernels read them, against the narrowest type, in which they are held."""
    maps = [view.stored_labels for view in scene.train if view.stored_labels is not None]
    wide = sum(mask.numel() * 4 for mask in maps)
    known = all(torch.equal(narrowed(widened(mask)), mask) for mask in maps)
    narrow = sum(mask.numel() * mask.element_size() for mask in maps)
    return [Row("class maps of training views", "bytes", wide, narrow, measure="labels", difference=float(not known))]


def images(scene: Scene) -> list[Row]:
    """Training images in float while classes are prepared, which looks at none."""
    whole = sum(view.pixels[..., :3].numel() * 4 for view in scene.train)
    return [Row("training images as floats, in the preparation", "bytes", whole, 0.0)]


def in_turn(*ways: Callable[[], object]) -> tuple[list[float], list]:
    """Median seconds of each way, and what it returned; they take turns, ``CALLS`` times each."""
    seconds: list[list[float]] = [[] for _ in ways]
    results: list[object] = [None] * len(ways)
    for _ in range(CALLS):
        for index, way in enumerate(ways):
            start = time.perf_counter()
            results[index] = way()
            seconds[index].append(time.perf_counter() - start)
    return [median(values) for values in seconds], results


def draw(scene: Scene, surfels: Surfels, views: Sequence[View] | None = None) -> list[Tensor]:
    """Colours of the held-out (or other) views, on black."""
    settings = replace(scene.settings, geometry=False, distortion=False)
    with torch.no_grad():
        return [
            scene.rasterizer.rasterize(surfel_inputs(surfels, view.camera), view.camera, settings, torch.zeros(3)).color
            for view in (scene.test if views is None else views)
        ]


def mean_psnr(pictures: Sequence[Tensor], views: Sequence[View]) -> float:
    """Mean over views, dB."""
    values = [psnr(picture, view.image) for picture, view in zip(pictures, views, strict=True)]
    return sum(values) / len(values)


def _bytes(grid: VisibilityGrid) -> float:
    stored = grid.keys.numel() * grid.keys.element_size() + grid.classes.numel() * grid.classes.element_size()
    lookup = grid.lookup()
    return float(stored + (lookup.bytes if lookup is not None else 0))


_COLUMNS = ("not needed", "of", "all", "needed", "share", "timed", "all, ms", "needed, ms", "difference")


def cells(row: Row) -> list[str]:
    """A line of the table."""
    times = [number(None if value is None else 1000 * value, 1) for value in (row.seconds_whole, row.seconds_needed)]
    share = number(100 * row.needed / row.whole if row.whole else None, 1) + " %"
    if row.difference is None:
        difference = ""
    elif row.difference == 0.0:
        difference = "none"
    else:
        difference = f"{row.difference:.4f} {row.measure}"
    return [row.what, row.unit, f"{row.whole:,.0f}", f"{row.needed:,.0f}", share, row.timed, *times, difference]
