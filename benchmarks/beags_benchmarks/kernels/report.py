"""Tables of a measurement."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from beags_benchmarks.kernels.measure import RASTERIZER_PARTS, Result


def print_result(result: Result, about: dict[str, Any], console: Console) -> None:
    """Print all measurements."""
    machine = about["machine"]
    console.print(
        f"{machine['cpu']}, {machine['cores']} cores, {machine['memory_mb']} MB; torch {about['torch']}; commit "
        f"{about['commit']}; {about['command']}",
        soft_wrap=True,
    )
    console.print(
        "Milliseconds: the least of all calls, in interleaved rounds; in brackets the median. With 1 thread it is CPU "
        "time, with more wall time. float32, all outputs.",
        soft_wrap=True,
    )
    _print_rows(result, console)
    _print_scenes(result, console)
    if result.step:
        _print_step(result.step, console)
    for note in dict.fromkeys(result.notes):
        console.print(note, soft_wrap=True)


def _print_rows(result: Result, console: Console) -> None:
    table = Table(title="Rasterizers")
    names = ("size", "backend", "isa", "threads", "forward", "backward", "wall, both", "calls", "to torch", "peak MB")
    for name in names:
        table.add_column(name, justify="left" if name in ("size", "backend", "isa") else "right")
    previous = None
    for row in result.rows:
        size = f"{row['n']}, {row['width']}x{row['height']}"
        if previous not in (None, size):
            table.add_section()
        table.add_row(
            "" if size == previous else size,
            row["backend"],
            row["isa"] or "",
            str(row["threads"]),
            f"{_ms(row['forward_ms'])} ({_ms(row['forward_median_ms'])})",
            f"{_ms(row['backward_ms'])} ({_ms(row['backward_median_ms'])})",
            _ms(row["wall_ms"]),
            str(row["calls"]),
            "" if row["ratio_to_torch"] is None else f"{row['ratio_to_torch']:.3g}x",
            "" if row["peak_mb"] is None else f"{row['peak_mb']:.0f}",
        )
        previous = size
    console.print(table)


def _print_scenes(result: Result, console: Console) -> None:
    table = Table(title="Scenes and the native rasterizer's work")
    names = ("size", "median width, px", "layers per pixel", "lanes", "contributing", "lanes per pair")
    for name in (*names, "tile pairs", "of box pairs", "projection + binning", "same bits"):
        table.add_column(name, justify="left" if name == "size" else "right")
    for scene in result.scenes:
        work = scene.get("work")
        image = scene["size"].split("/")[1].split("x")
        counts = ["-"] * 6
        if work:
            counts = [
                f"{work['contributing'] / (int(image[0]) * int(image[1])):.1f}",
                f"{work['lanes']:,}",
                f"{work['contributing']:,}",
                f"{work['lanes'] / max(work['contributing'], 1):.2f}",
                f"{work['tile_pairs']:,}",
                f"{work['tile_pairs'] / max(work['box_pairs'], 1):.2f}",
            ]
        first = scene.get("projection_binning_ms")
        table.add_row(
            scene["size"], f"{scene['median_width']:.1f}", *counts, "-" if first is None else f"{_ms(first)} ms",
            {True: "yes", False: "NO", None: "-"}[scene.get("same_bits")],
        )  # fmt: skip
    console.print(table)


def _print_step(step: dict[str, Any], console: Console) -> None:
    share = step["sampled_share"]
    title = f"A training step, {step['size']}, {step['threads']} thread(s), ms"
    if share is not None:
        title += f"; {100 * share:.0f} % of the surfels take samples"
    table = Table(title=title)
    table.add_column("part")
    kinds = list(step["whole_ms"])
    for kind in kinds:
        samples = step["samples"][kind]
        table.add_column(kind if samples is None else f"refinement, Z = {samples}", justify="right")
    parts = list(dict.fromkeys(part for kind in kinds for part in step["parts_ms"][kind]))
    for part in parts:
        values = [step["parts_ms"][kind].get(part) for kind in kinds]
        table.add_row(part, *("" if value is None else _ms(value) for value in values))
    table.add_section()
    table.add_row("whole step", *(_ms(step["whole_ms"][kind]) for kind in kinds))
    table.add_row("outside the rasterizer", *(f"{100 * outside_share(step, kind):.0f} %" for kind in kinds))
    peaks = [step["peak_mb"].get(kind) for kind in kinds]
    table.add_row("peak MB", *("-" if peak is None else f"{peak:.0f}" for peak in peaks))
    console.print(table)
    o = step["overhead"]
    console.print(
        f"Small scene, {o['size']}: a step takes {_ms(o['small_step_ms'])} ms, and {_ms(o['empty_step_ms'])} ms with 1 "
        f"surfel on 16x16 pixels, which is what Python, bindings and dispatch cost; the rasterizer "
        f"{_ms(o['small_rasterizer_ms'])} and {_ms(o['empty_rasterizer_ms'])} ms.",
        soft_wrap=True,
    )


def outside_share(step: dict[str, Any], kind: str) -> float:
    """Return the share of a step's time outside of its rasterizer."""
    own = sum(step["parts_ms"][kind][part] for part in RASTERIZER_PARTS)
    return max(0.0, 1.0 - own / step["whole_ms"][kind])


def _ms(value: float) -> str:
    return f"{value:.2f}" if value < 10 else f"{value:.1f}" if value < 100 else f"{value:.0f}"
