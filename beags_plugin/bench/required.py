"""``beags bench required``: what a trained scene stores and computes for nothing, and what leaving it out saves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from rich.console import Console
from torch import Tensor

from beags_plugin.assignment.assignment import assign_classes
from beags_plugin.bench.report import number, plain_table, provenance, write_csv, write_json
from beags_plugin.bench.required_rows import Row, Scene, draw, in_turn, mean_psnr
from beags_plugin.bench.required_views import bands, objects, pairs
from beags_plugin.bench.run import TABLE_WIDTH
from beags_plugin.labels.label_maps import narrowed, widened
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.sampling import sample_stream
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import progress_bar

if TYPE_CHECKING:
    from beags_plugin.plugin.runs.read import SavedScene
    from beags_plugin.plugin.views.datamanager import BeagsDataManager

CONSOLE = Console(soft_wrap=True, highlight=False, markup=False)  # paths may hold brackets
PIXELS = (0.25, 0.5, 1.0, 2.0, 4.0)  # what a Gaussian must fill in some view to be kept


def run_required(config: Path, json: Path | None = None, csv: Path | None = None) -> list[Row]:
    """Measure a run, print a table and write the files that are asked for; returns the rows.

    Of a base without classes, what does not take any is measured.

    config: config.yml of the run. Raises ``UserError`` if it is none, or holds no refinement.
    """
    scene = load(config)
    rows: list[Row] = []
    parts: tuple[Callable[[Scene], list[Row]], ...] = (
        gaussians,
        bands,
        objects,
        pairs,
        samples,
        voxels,
        class_maps,
        images,
    )
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
    from beags_plugin.plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.plugin.runs.layout import last_prepared
    from beags_plugin.plugin.runs.prepared import grid_state

    run = EvaluatedRun(config)
    after: SavedScene = run.stages["after"]
    if "before" not in run.stages and after.class_ids is not None:
        raise UserError(f"{config.parent} keeps no base beside its scene: name a run of beags that was refined.")
    before: SavedScene = run.stages.get("before", after)
    kept = last_prepared(config.parent) / "grid.pt"
    state = grid_state(kept) if kept.exists() else {}
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
