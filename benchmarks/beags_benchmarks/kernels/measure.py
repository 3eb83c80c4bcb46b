"""Measurements of the rasterizers: workers alternate on each case and give one result."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from beags_benchmarks.kernels.scenes import SIZES, Size
from beags_benchmarks.kernels.worker import Worker

REFINEMENT_SAMPLES = 20  # Z of the preset
MANY_SAMPLES = 1000
EMPTY = "1/16x16"  # a step with almost no work: its time is that of Python, bindings and dispatch
OVERHEAD_SIZE = SIZES[0]
STEP_SIZE = SIZES[2]
RASTERIZER_PARTS = ("rasterizer forward", "rasterizer backward")  # parts of a step with which the rest is compared
MEASURED_MEMORY = ("native", "torch", "step")
# Cost of a pixel in one layer, forward and backward, relative to the native rasterizer; for the time left only.
_COST = {"native": 1.0, "torch": 80.0}
LARGEST_SLOW = 100_000  # surfels; larger cases are for the native rasterizer only


@dataclass
class Options:
    """The things to measure; see ``rasterizer.py``."""

    sizes: list[Size]
    threads: list[int]
    rounds: int
    seconds: float  # length of one turn
    budget: float  # seconds of all turns of one entry
    torch: bool = True
    step: bool = True
    memory: tuple[str, ...] = MEASURED_MEMORY
    torch_large: bool = False
    step_size: Size = STEP_SIZE
    overhead_size: Size = OVERHEAD_SIZE
    many_samples: int = MANY_SAMPLES


@dataclass
class Series:
    """Timings of one entry, milliseconds of wall and CPU time.

    CPU time counts with one thread, because other programs hardly change it; with more threads wall time counts.
    """

    threads: int
    values: list[tuple[float, float]] = field(default_factory=list)

    @property
    def best(self) -> float:
        return min(self._counting())

    @property
    def median(self) -> float:
        return statistics.median(self._counting())

    @property
    def wall(self) -> float:
        return min(wall for wall, _ in self.values)

    def _counting(self) -> list[float]:
        return [cpu if self.threads == 1 else wall for wall, cpu in self.values]


@dataclass
class Result:
    """All measurements.

    rows: one per (size, backend, isa, threads). scenes: per size. step: see ``measure_step``. notes: sentences.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    scenes: list[dict[str, Any]] = field(default_factory=list)
    step: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


Advance = Callable[[float, str], None]  # takes work done, in units of the total, and the next entry


class Session:
    """The workers of one run: ``best`` has the best instruction set and all backends, ``others`` one other ISA each."""

    def __init__(self, stack: ExitStack, options: Options, notes: list[str]) -> None:
        names = ["native", *(["torch"] if options.torch else [])]
        self.best = stack.enter_context(Worker())
        hello = self.best.ask("hello", names=names)
        self.torch_version = hello["torch"]
        self.isa: str | None = hello["isa"]
        self.backends = [name for name in names if hello["reasons"][name] is None]
        for name in names:
            if hello["reasons"][name] is not None:
                notes.append(f"not measured: {name}, {hello['reasons'][name]}")
        self.others: dict[str, Worker] = {}
        for isa in hello["isas"]:
            if isa == self.isa:
                continue
            worker = stack.enter_context(Worker(isa))
            answer = worker.ask("hello", names=["native"])
            if answer["isa"] == isa:
                self.others[isa] = worker
            else:
                notes.append(f"not measured: instruction set {isa}, it cannot run here ({answer['reasons']['native']})")

    def entries(self, size: Size, options: Options, notes: list[str]) -> Iterator[tuple[str, str | None, int]]:
        """Yield (backend, isa, threads) of every timed entry at a size."""
        for name in self.backends:
            if name == "torch" and size.n > LARGEST_SLOW and not options.torch_large:
                notes.append(f"not measured: {name} at {size.name}, where a call takes minutes and gigabytes")
                continue
            for threads in options.threads:
                yield name, self.isa if name == "native" else None, threads
        if "native" in self.backends:
            for isa in self.others:
                for threads in options.threads:
                    yield "native", isa, threads

    def worker(self, isa: str | None) -> Worker:
        return self.best if isa in (None, self.isa) else self.others[isa]


def work(size: Size) -> float:
    """Return the approximate number of pixels times layers."""
    return size.n * 0.96 * size.diameter**2


def total_work(options: Options) -> float:
    """Return the approximate sum of the work that ``advance`` receives, for the time left."""
    kinds = 4 + _COST["torch"] * options.torch
    cases = sum(work(size) * (kinds if size.n <= LARGEST_SLOW else 4) for size in options.sizes)
    return cases * len(options.threads) * 2 + work(options.step_size) * 100 * options.step


def measure_sizes(session: Session, options: Options, result: Result, advance: Advance) -> None:
    """Fill ``rows`` and ``scenes``."""
    for size in options.sizes:
        entries = list(session.entries(size, options, result.notes))
        description = session.best.ask("describe", size=size.name)
        result.scenes.append({"size": size.name, **description})
        timed = _interleave(session, size, entries, options, advance)
        native_work = description["work"]
        for entry in entries:
            backend, isa, threads = entry
            forward, backward = timed[entry]["forward"], timed[entry]["backward"]
            reference = timed.get(("torch", None, threads))
            total = forward.best + backward.best
            lanes = native_work["lanes"] / max(native_work["contributing"], 1) if native_work else None
            result.rows.append(
                {
                    "n": size.n,
                    "width": size.width,
                    "height": size.height,
                    "backend": backend,
                    "isa": isa,
                    "threads": threads,
                    "forward_ms": forward.best,
                    "backward_ms": backward.best,
                    "forward_median_ms": forward.median,
                    "backward_median_ms": backward.median,
                    "wall_ms": forward.wall + backward.wall,
                    "calls": len(forward.values),
                    "ratio_to_torch": None
                    if reference is None
                    else (reference["forward"].best + reference["backward"].best) / total,
                    "lanes_per_pair": lanes if backend == "native" else None,
                    "peak_mb": _peak(size, entry, session, options, result.notes, advance),
                }
            )
        if "native" in session.backends:
            _add_stages(session, size, options, result.scenes[-1])


def _interleave(
    session: Session, size: Size, entries: list, options: Options, advance: Advance
) -> dict[Any, dict[str, Series]]:
    """Run rounds in which every entry has a turn; a slow entry stops when its budget is spent."""
    timed = {entry: {stage: Series(entry[2]) for stage in ("forward", "backward")} for entry in entries}
    spent = dict.fromkeys(entries, 0.0)
    for turn in range(options.rounds):
        for entry in entries:
            backend, isa, threads = entry
            advance(work(size) * _COST[backend] / options.rounds, f"{size.name} {backend} {isa or ''} x{threads}")
            if turn > 0 and spent[entry] >= 1e3 * options.budget:
                continue
            answer = session.worker(isa).ask(
                "time", size=size.name, backend=backend, threads=threads, seconds=options.seconds
            )
            for stage, values in answer.items():
                timed[entry][stage].values += values
                spent[entry] += sum(wall for wall, _ in values)
    return timed


def _peak(size: Size, entry, session: Session, options: Options, notes: list[str], advance: Advance) -> float | None:
    """Return the peak memory for the best instruction set and the first number of threads; others need the same."""
    backend, isa, threads = entry
    if backend not in options.memory or isa not in (None, session.isa) or threads != options.threads[0]:
        return None
    advance(work(size) * _COST[backend], f"{size.name} {backend} memory")
    return peak_in_new_process(notes, f"{backend} at {size.name}", size=size.name, threads=threads, backend=backend)


def peak_in_new_process(notes: list[str], what: str, **arguments: Any) -> float | None:
    """Return the peak MB; None and a note if the process failed."""
    try:
        with Worker() as worker:
            return worker.ask("peak", **arguments)
    except RuntimeError as error:
        notes.append(f"not measured: memory of {what}, {error}")
        return None


def _add_stages(session: Session, size: Size, options: Options, scene: dict[str, Any]) -> None:
    """Add "projection_binning_ms" and "same_bits", whether 1, 2 and 4 threads give the same bits, to ``scene``."""
    threads = options.threads[0]
    frame = session.best.ask("stages", size=size.name, threads=threads, seconds=options.seconds)
    scene["projection_binning_ms"] = Series(threads, frame).best
    digests = {session.best.ask("digest", size=size.name, threads=count) for count in (1, 2, 4)}
    scene["same_bits"] = len(digests) == 1


def measure_step(session: Session, options: Options, result: Result, advance: Advance) -> None:
    """Fill ``step`` with whole steps, their parts, refinement, overhead and memory."""
    if "native" not in session.backends:
        result.notes.append("not measured: training steps, the native rasterizer is missing")
        return
    size, threads = options.step_size, options.threads[0]
    kinds = {"base": None, "refinement": REFINEMENT_SAMPLES, "many samples": options.many_samples}
    rounds = max(options.rounds, 2)
    whole = {kind: Series(threads) for kind in kinds}
    parts: dict[str, dict[str, Series]] = {kind: {} for kind in kinds}
    for _ in range(rounds):
        for kind, samples in kinds.items():
            advance(work(size) * 90 / rounds / len(kinds), f"{size.name} step {kind}")
            request = {"size": size.name, "threads": threads, "seconds": options.seconds, "samples": samples}
            whole[kind].values += session.best.ask("step", **request)["step"]
            for part, values in session.best.ask("step", parts=True, **request).items():
                parts[kind].setdefault(part, Series(threads)).values += values
    step = {
        "size": size.name,
        "threads": threads,
        "samples": kinds,
        "sampled_share": session.best.ask("sampled", size=size.name),
        "whole_ms": {kind: series.best for kind, series in whole.items()},
        "parts_ms": {kind: {part: series.best for part, series in by_part.items()} for kind, by_part in parts.items()},
        "overhead": _overhead(session, options, rounds),
        "peak_mb": {},
    }
    if math.isnan(step["sampled_share"]):
        step["sampled_share"] = None
    if "step" in options.memory:
        for kind, samples in kinds.items():
            advance(work(size) * 3, f"{size.name} step {kind} memory")
            arguments = {"size": size.name, "threads": threads, "samples": samples}
            step["peak_mb"][kind] = peak_in_new_process(result.notes, f"a step, {kind}", **arguments)
    result.step = step


def _overhead(session: Session, options: Options, rounds: int) -> dict[str, Any]:
    """Measure a small scene and an almost empty one, for the rasterizer and a whole step."""
    threads = options.threads[0]
    timings: dict[str, Series] = {}
    for _ in range(rounds):
        for name, size in (("empty", EMPTY), ("small", options.overhead_size.name)):
            request = {"size": size, "threads": threads, "seconds": options.seconds}
            timings.setdefault(f"{name}_step", Series(threads)).values += session.best.ask("step", **request)["step"]
            answer = session.best.ask("time", backend="native", **request)
            for (wall, cpu), (more_wall, more_cpu) in zip(answer["forward"], answer["backward"], strict=True):
                series = timings.setdefault(f"{name}_rasterizer", Series(threads))
                series.values.append((wall + more_wall, cpu + more_cpu))
    return {"size": options.overhead_size.name, **{f"{name}_ms": series.best for name, series in timings.items()}}
