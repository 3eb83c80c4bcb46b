"""A long refinement: does memory stay flat, and is anything left behind when it ends?

    python tests/soak/long_run.py --json long_run.json --picture long_run.png

Trains beags-tiny with 2,000 refinement steps on a small generated sample, in a process of its own (Linux), with the
curves and checkpoints of the preset. Asked at regular steps is what the process holds: resident memory, threads, open
files, child processes. Exit status 1 if

- memory grows over the second half of refinement by more than ``NOISE_MB`` (the line through all values there, by the
  median of the slopes between any two of them),
- the number of threads, open files or child processes is not the same at all steps of the second half, or
- the end finds a thread, an open file or a child process that was not there before the run, or a process lives on.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]
from beags_plugin.sample.writer import SampleConfig, write_sample
from beags_plugin.system.child_processes import bound

NOISE_MB = 2.0  # Allocators and libraries move memory by this with nothing kept; 1 kB a step would be as much.
COUNTED = ("threads", "files", "children")
OBSERVED = Path(__file__).with_name("observed_training.py")


def main() -> int:
    """Parse arguments, train, judge, report; returns the exit status."""
    from beags_benchmarks.provenance import commit, describe_machine

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=2000, help="of refinement")
    parser.add_argument("--base-steps", type=int, default=600)
    parser.add_argument("--every", type=int, default=10, help="steps from one look to the next")
    parser.add_argument("--json", type=Path, default=None, help="file for what was found")
    parser.add_argument("--picture", type=Path, default=None, help="PNG of memory, threads and files over the steps")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="beags-long-run-") as folder:
        record = trained(Path(folder), arguments.base_steps, arguments.steps, arguments.every)
    growth, failures = judged(record)
    refinement = [line for line in record if line["phase"] == "refinement"]
    memory = [line["memory_mb"] for line in refinement]
    ends = {"before": record[0]["memory_mb"], "after": record[-1]["memory_mb"]}
    report = {
        "steps": arguments.steps, "base_steps": arguments.base_steps,
        "memory_mb": {**ends, "refinement": [min(memory), max(memory)]},
        "growth_of_second_half_mb": growth, "noise_mb": NOISE_MB, "failures": failures,
        **{name: sorted({len(line[name]) for line in refinement}) for name in COUNTED},
        "commit": commit(), "machine": describe_machine(),
        "over_steps": [[line["step"], line["memory_mb"], *(len(line[name]) for name in COUNTED)] for line in record],
    }  # fmt: skip
    if arguments.json:
        arguments.json.write_text(json.dumps(report))
    if arguments.picture:
        draw(record, arguments.base_steps, arguments.picture)
    print(f"memory {min(memory):.1f} to {max(memory):.1f} MB over {arguments.steps:,} steps of refinement; its second")
    print(f"half grows by {growth:.2f} MB (noise: {NOISE_MB} MB)", *failures or ["nothing is left behind"], sep="; ")
    return int(bool(failures))


def trained(folder: Path, base_steps: int, steps: int, every: int, *options: str) -> list[dict[str, Any]]:
    """Return what a training in ``folder`` held: ``observed_training``'s lines; more options of ns-train may follow.

    Raises ``RuntimeError`` if it fails, or leaves a process behind.
    """
    data = folder / "data"
    write_sample(data, SampleConfig(seed=3, width=96, height=72, num_train=16, num_test=3))
    words = [
        sys.executable, OBSERVED, folder / "record", every, "beags-tiny", "--data", data, "--run-dir", folder / "run",
        "--vis", "tensorboard", "--pipeline.model.base-steps", base_steps, "--pipeline.model.refine-steps", steps,
        "--pipeline.model.densify.stop", base_steps * 2 // 3, "--pipeline.model.prepare.k", 200, *options,
    ]  # fmt: skip
    with open(folder / "log.txt", "wb") as log:
        process = subprocess.Popen(bound(words, signal.SIGKILL), stdout=log, stderr=log, start_new_session=True)
        code = process.wait()
    if code != 0:
        raise RuntimeError(f"the training ended with exit code {code}: {(folder / 'log.txt').read_text()[-3000:]}")
    if left := in_session(process.pid):
        raise RuntimeError(f"the training has ended, but not its processes: {left}")
    return [json.loads(line) for line in (folder / "record").read_text().splitlines()]


def in_session(leader: int) -> list[str]:
    """Return the names of the processes of a session."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            name, _, rest = stat.read_text().rpartition(")")
        except OSError:  # it has just ended
            continue
        if int(rest.split()[3]) == leader:
            found.append(name.partition("(")[2])
    return found


def judged(record: list[dict[str, Any]]) -> tuple[float, list[str]]:
    """Return the MB by which memory grows over the second half of refinement, and sentences on what is wrong."""
    refinement = [line for line in record if line["phase"] == "refinement"]
    half = refinement[len(refinement) // 2 :]
    growth = slope([line["step"] for line in half], [line["memory_mb"] for line in half])
    growth *= half[-1]["step"] - half[0]["step"]
    failures = [f"memory grows by {growth:.2f} MB over the second half of refinement"] if growth > NOISE_MB else []
    for name in COUNTED:
        if len({len(line[name]) for line in half}) > 1:
            failures.append(f"the number of {name} changes in refinement: {[len(line[name]) for line in half]}")
    before, after = record[0], record[-1]
    for name in ("python_threads", "files", "children"):
        left = list(after[name])
        for one in before[name]:
            if one in left:
                left.remove(one)
        if left:
            failures.append(f"{name.replace('_', ' ')} left behind: {left}")
    return growth, failures


def slope(x: list[float], y: list[float]) -> float:
    """Return the median slope between any two points (Theil 1950, Sen 1968): a jump of one point does not tilt it."""
    pairs = ((i, j) for i in range(len(x)) for j in range(i))
    return median((y[i] - y[j]) / (x[i] - x[j]) for i, j in pairs)


def draw(record: list[dict[str, Any]], base_steps: int, path: Path) -> None:
    """Draw memory above, threads and open files below, over the steps."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    lines = [line for line in record if line["step"] is not None]
    steps = [line["step"] for line in lines]
    figure, (above, below) = plt.subplots(2, 1, figsize=(6, 3.6), sharex=True, height_ratios=(2, 1))
    above.plot(steps, [line["memory_mb"] for line in lines], color="tab:blue")
    above.set_ylabel("resident memory (MB)")
    above.set_ylim(0, 1.15 * max(line["memory_mb"] for line in lines))
    for name, color in (("threads", "tab:orange"), ("files", "tab:green"), ("children", "tab:red")):
        below.plot(steps, [len(line[name]) for line in lines], color=color, label=name)
    below.set_ylim(-0.5, 1.5 + max(len(line[name]) for line in lines for name in COUNTED))
    below.legend(fontsize=7, ncols=3)
    below.set_xlabel("step")
    for axes in (above, below):
        axes.axvline(base_steps, color="0.6", linewidth=0.8, linestyle="--")
        axes.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    sys.exit(main())
