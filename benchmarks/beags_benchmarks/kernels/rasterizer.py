"""Measure the rasterizers and a whole training step: python -m beags_benchmarks.kernels.rasterizer --help."""

from __future__ import annotations

import json
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from beags_benchmarks.kernels.measure import (
    MEASURED_MEMORY,
    Options,
    Result,
    Session,
    measure_sizes,
    measure_step,
    total_work,
)
from beags_benchmarks.kernels.report import print_result
from beags_benchmarks.kernels.scenes import SIZES, parse_size
from beags_benchmarks.provenance import busy_note, command, commit, describe_machine
from beags_plugin.system.errors import UserError

QUICK_SIZE = "300/64x48"


@dataclass
class Arguments:
    """Measure the compiled rasterizer and the torch reference in turn, then whole training steps."""

    sizes: tuple[str, ...] = tuple(size.name for size in SIZES)
    """Sizes of 1k 10k 50k 200k, or N/WIDTHxHEIGHT."""
    threads: tuple[int, ...] = (1, 2)
    """Numbers of threads."""
    rounds: int = 7
    """Rounds in which every entry has a turn."""
    seconds: float = 0.3
    """Length of a turn in seconds; a longer call is one turn."""
    budget: float = 20.0
    """Seconds after which a slow backend has no more turns at a size; it always has one."""
    torch: bool = True
    """Measure the torch reference (never at 200k, see torch-large)."""
    torch_large: bool = False
    """Measure the torch reference at 200k too: minutes and gigabytes."""
    step: bool = True
    """Measure a whole training step of 50k surfels and the overhead at 1k."""
    memory: bool = True
    """Measure peak memory, each case in a process of its own."""
    quick: bool = False
    """Measure one tiny size in two short rounds, and a small step, to test the benchmark."""
    json: Path | None = None
    """File to write everything to."""

    def options(self) -> Options:
        """Return the options of the measurement; raises ``UserError`` for an invalid size or number."""
        if self.quick:
            small = parse_size(QUICK_SIZE)
            return Options(
                [small], list(self.threads), 2, 0.02, 2.0, self.torch,
                self.step, ("native",), step_size=small, overhead_size=small, many_samples=40,
            )  # fmt: skip
        if self.rounds < 1 or not self.threads or min(self.threads) < 1 or not self.sizes:
            raise UserError("at least one size, one round and one thread are needed.")
        return Options(
            [parse_size(size) for size in self.sizes], list(self.threads), self.rounds, self.seconds, self.budget,
            self.torch, self.step, MEASURED_MEMORY if self.memory else (), self.torch_large,
        )  # fmt: skip


def main(arguments: list[str]) -> None:
    """Measure, print the tables and write the file."""
    chosen = tyro.cli(Arguments, args=arguments)
    console = Console(width=None if sys.stdout.isatty() else 140)
    try:
        options = chosen.options()
    except UserError as error:
        console.print(f"benchmark: {error}")
        sys.exit(2)
    result, machine = Result(), describe_machine()
    if note := busy_note(int(machine["cores"])):
        result.notes.append(note)
    columns = (TextColumn("{task.description:<36}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with ExitStack() as stack:
        progress = stack.enter_context(Progress(*columns, console=Console(stderr=True), transient=True))
        task = progress.add_task("starting", total=total_work(options))
        session = Session(stack, options, result.notes)

        def advance(work: float, what: str) -> None:
            progress.update(task, advance=work, description=what)

        measure_sizes(session, options, result, advance)
        if options.step:
            measure_step(session, options, result, advance)
    about = {"machine": machine, "commit": commit(), "command": command(), "torch": session.torch_version}
    print_result(result, about, console)
    if chosen.json is not None:
        content = {**about, "rows": result.rows, "scenes": result.scenes, "step": result.step, "notes": result.notes}
        chosen.json.write_text(json.dumps(content, indent=1) + "\n")
        console.print(f"written: {chosen.json}")


if __name__ == "__main__":
    main(sys.argv[1:])
