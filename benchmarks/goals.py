"""The goals of the compiled rasterizer, checked against its measurements."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.measure import RASTERIZER_PARTS, Result
from benchmarks.scenes import SIZES, Size

SMALL, MEDIUM, LARGE = SIZES[0], SIZES[1], SIZES[2]
SIMD_FACTORS = {"avx2": (5.0, 6.0), "avx512": (7.0, 9.0)}  # against the scalar build: required, aim
MEMORY_SLACK_MB = 8.0  # what two runs of the same thing differ by


@dataclass(frozen=True)
class Goal:
    """A goal and its measurement.

    name: of the comparison. bound: the requirement. measured: the figure in words, or the reason that it lacks.

    met: None where it was not measured.
    """

    name: str
    bound: str
    measured: str
    met: bool | None

    def line(self) -> str:
        """Return the line to print."""
        word = {True: "met", False: "NOT MET", None: "not measured"}[self.met]
        return f"goal {word}: {self.name}: {self.measured} ({self.bound})"


def check_goals(result: Result, isa: str | None) -> list[Goal]:
    """Return all goals in the order of the specification, also those without a measurement."""
    table = _Table(result.rows, isa)
    return [
        *_against_reference(table),
        *_simd(table),
        *_threads(table, result),
        *_absolute(table),
        *_work(result),
        *_memory(table),
        *_step(result.step),
    ]


class _Table:
    """Rows by the thing that they measure."""

    def __init__(self, rows: list[dict[str, Any]], isa: str | None) -> None:
        self.isa = isa
        self._rows = {
            (row["n"], row["width"], row["height"], row["backend"], row["isa"], row["threads"]): row for row in rows
        }

    def row(self, size: Size, backend: str = "native", isa: str | None = "", threads: int = 1) -> dict | None:
        isa = (self.isa if backend == "native" else None) if isa == "" else isa
        return self._rows.get((size.n, size.width, size.height, backend, isa, threads))

    def ms(self, size: Size, backend: str = "native", isa: str | None = "", threads: int = 1) -> float | None:
        row = self.row(size, backend, isa, threads)
        return None if row is None else row["forward_ms"] + row["backward_ms"]


def _factor(name: str, bound: str, required: float, value: float | None, aim: float | None = None) -> Goal:
    if value is None:
        return Goal(name, bound, "no figure", None)
    reached = f"{value:.2f}x" if value < 10 else f"{value:.0f}x"
    if aim is not None and value >= aim:
        reached += ", the aim is reached"
    return Goal(name, bound, reached, value >= required)


def _quotient(above: float | None, below: float | None) -> float | None:
    return None if above is None or below is None or below <= 0 else above / below


def _against_reference(table: _Table) -> Iterator[Goal]:
    for size in (MEDIUM, LARGE):
        value = _quotient(table.ms(size, "torch"), table.ms(size))
        name = f"native against the torch reference, {size.name}, 1 thread"
        yield _factor(name, "required 60x, aim 100x", 60.0, value, 100.0)


def _simd(table: _Table) -> Iterator[Goal]:
    for isa, (required, aim) in SIMD_FACTORS.items():
        sizes = [size for size in (LARGE, MEDIUM, SMALL) if table.ms(size, isa=isa)]
        size = sizes[0] if sizes else LARGE
        value = _quotient(table.ms(size, isa="scalar"), table.ms(size, isa=isa))
        name = f"{isa} against the scalar build, {size.name}, 1 thread"
        yield _factor(name, f"required {required:g}x, aim {aim:g}x", required, value, aim)


def _threads(table: _Table, result: Result) -> Iterator[Goal]:
    for size in SIZES[1:]:
        # wall time of both: CPU time says nothing of two threads
        one, two = table.row(size), table.row(size, threads=2)
        value = _quotient(one and one["wall_ms"], two and two["wall_ms"])
        yield _factor(f"2 threads against 1, {size.name}", "required 1.85x, aim 1.95x", 1.85, value, 1.95)
    known = [scene for scene in result.scenes if "same_bits" in scene]
    met = all(scene["same_bits"] for scene in known) if known else None
    different = [scene["size"] for scene in known if not scene["same_bits"]]
    measured = "no figure" if not known else f"different at {', '.join(different)}" if different else "equal"
    yield Goal("the same bits for 1, 2 and 4 threads", "equal", measured, met)


def _absolute(table: _Table) -> Iterator[Goal]:
    ms = table.ms(LARGE, isa="avx512")
    name = f"{LARGE.name}, AVX-512, 1 thread (on a machine like the specification's)"
    measured = "no figure: no AVX-512 here" if ms is None else f"{ms:.0f} ms"
    yield Goal(name, "required 100 ms, aim 65 ms", measured, None if ms is None else ms <= 100)


def _work(result: Result) -> Iterator[Goal]:
    counted = [(scene["size"], scene["work"]) for scene in result.scenes if scene.get("work")]
    for name, bound, above, below in (
        ("evaluated lanes per contributing pair", 1.5, "lanes", "contributing"),
        ("(tile, surfel) pairs over those of 3.33-sigma boxes", 0.85, "tile_pairs", "box_pairs"),
    ):
        values = {size: work[above] / max(work[below], 1) for size, work in counted}
        measured = ", ".join(f"{value:.2f} at {size}" for size, value in values.items()) or "no figure"
        met = max(values.values()) <= bound if values else None
        yield Goal(name, f"at most {bound:g}", measured, met)


def _memory(table: _Table) -> Iterator[Goal]:
    row = table.row(LARGE)
    peak: float | None = None if row is None else row["peak_mb"]
    measured = "no figure" if peak is None else f"{peak:.0f} MB"
    yield Goal(f"extra memory at {LARGE.name}", "at most 100 MB", measured, None if peak is None else peak <= 100)


def _step(step: dict[str, Any]) -> Iterator[Goal]:
    size = step.get("size", LARGE.name)
    whole, parts = step.get("whole_ms", {}), step.get("parts_ms", {})
    own = sum(parts["base"][part] for part in RASTERIZER_PARTS) if parts else None
    for name, bound, value in (
        (f"a training step over the rasterizer's own share, {size}", 1.3, _quotient(whole.get("base"), own)),
        (
            f"a refinement step (Z = 20) over a base step, {size}",
            1.05,
            _quotient(whole.get("refinement"), whole.get("base")),
        ),
    ):
        measured = "no figure" if value is None else f"{value:.3f}x"
        yield Goal(name, f"at most {bound:g}x", measured, None if value is None else value <= bound)
    peaks = step.get("peak_mb", {})
    few, many = peaks.get("refinement"), peaks.get("many samples")
    known = few is not None and many is not None
    measured = f"{many:.0f} MB against {few:.0f} MB" if known else "no figure"
    samples = step.get("samples", {}).get("many samples", 1000)
    yield Goal(
        f"memory of a refinement step, Z = {samples} against Z = 20, {size}",
        f"no more ({MEMORY_SLACK_MB:g} MB are noise)",
        measured,
        None if few is None or many is None else many <= few + MEMORY_SLACK_MB,
    )
    overhead = step.get("overhead", {})
    for what in ("rasterizer", "step"):
        share = _quotient(overhead.get(f"empty_{what}_ms"), overhead.get(f"small_{what}_ms"))
        name = f"Python, binding and dispatch in a {what} of {overhead.get('size', SMALL.name)}"
        measured = "no figure" if share is None else f"{100 * share:.0f} %"
        yield Goal(name, "below 20 %", measured, None if share is None else share < 0.2)


def as_json(goals: list[Goal]) -> list[dict[str, Any]]:
    """Return the goals as plain values."""
    return [asdict(goal) for goal in goals]
