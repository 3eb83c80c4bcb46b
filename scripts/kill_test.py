"""Kill a training at random moments, resume it, and compare: does it end bit for bit as without the kill?

    python scripts/kill_test.py --kills 8

Trains a short run of beags-tiny on a small generated scene once to its end. Then, again and again, starts the same run
in a folder of its own with ns-train, ends it with SIGKILL after a random amount of CPU time (Linux), resumes it with
``beags resume`` (which may be killed too), and compares what both left: the checkpoint with the optimizers' state, the
curve of held-out quality, the masks, the voxel grids. Prints a line per kill and leaves a JSON behind. Exit code 1:
something differed.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch

from beags_plugin.child_processes import bound

BIN = Path(sys.executable).parent
OPTIONS = {
    "--pipeline.model.base-steps": 320, "--pipeline.model.refine-steps": 80, "--pipeline.model.refine-rounds": 2,
    "--pipeline.model.densify.start": 100, "--pipeline.model.densify.stop": 300, "--pipeline.model.prepare.k": 200,
    "--steps-per-save": 20, "--steps-per-held-out": 50, "--vis": "tensorboard",
}  # fmt: skip


def main() -> int:
    """Parse arguments, run, report; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=8, help="how many kills in all")
    parser.add_argument("--again", type=float, default=0.3, help="share of resumes that are killed too")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--output", type=Path, default=Path("outputs/kill_test"), help="folder for everything")
    arguments = parser.parse_args()
    output = arguments.output.absolute()
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir(parents=True)
    data, whole = output / "data", output / "whole"
    write_data(data)
    code, first, seconds = run_whole(train_command(data, whole), output / "whole.log", whole / "config.yml")
    if code != 0:
        print(f"the run without a kill ended with exit code {code}: see {output / 'whole.log'}")
        return 1
    print(f"without a kill: {seconds:.1f} s of CPU time, of which {first:.1f} s before the run began", flush=True)
    moments, kills, trials = random.Random(arguments.seed), 0, []
    while kills < arguments.kills:
        run = output / f"run_{len(trials)}"
        killed, command = [], train_command(data, run)
        while kills < arguments.kills and (not killed or moments.random() < arguments.again):
            after = moments.uniform(first, seconds)
            log = output / f"{run.name}_{len(killed)}.log"
            if run_for(command, log, after, moments.uniform(0.0, 0.1)) == -signal.SIGKILL:
                kills += 1
                killed.append({"after": round(after, 2), "at": state_of(run)})
            if (run / "config.yml").exists():
                command = resume_command(run)
            if (run / "training.json").exists():
                break
        if not (run / "training.json").exists():
            run_for(command, output / f"{run.name}_end.log", None)
        found = differences(whole, run)
        trials.append({"killed": killed, "differs": found})
        at = "; ".join(f"{one['after']} s of CPU time: {one['at']}" for one in killed)
        print(f"{run.name}: killed at {at}: {'; '.join(found[:3]) or 'the same bits'}", flush=True)
        if not found:
            shutil.rmtree(run)
    wrong = sum(bool(trial["differs"]) for trial in trials)
    (output / "kill_test.json").write_text(json.dumps({"kills": kills, "seconds": seconds, "trials": trials}, indent=1))
    print(f"{kills} kills in {len(trials)} runs; {wrong} runs differ from the whole one. {output / 'kill_test.json'}")
    return int(wrong > 0)


def write_data(folder: Path) -> None:
    """The sample at a quarter of its size."""
    from beags_plugin.sample.writer import SampleConfig, write_sample

    write_sample(folder, SampleConfig(seed=3, width=96, height=72, num_train=16, num_test=3))


def train_command(data: Path, run: Path) -> list[str]:
    """What starts the run."""
    options = [str(word) for pair in OPTIONS.items() for word in pair]
    return [str(BIN / "ns-train"), "beags-tiny", "--data", str(data), "--run-dir", str(run), *options]


def resume_command(run: Path) -> list[str]:
    """What goes on with it."""
    return [sys.executable, "-m", "beags_plugin.cli", "resume", str(run)]


def run_for(command: list[str], log: Path, cpu_seconds: float | None, jitter: float = 0.0) -> int:
    """Run a command; kill it once it has had so much CPU time, if given, and ``jitter`` seconds have passed.

    Returns its exit code (-9: killed).
    """
    with open(log, "wb") as file, started(command, file) as process:
        while cpu_seconds is not None and process.poll() is None:
            if cpu_time(process.pid) >= cpu_seconds:
                time.sleep(jitter)  # a program that waits for the disk uses no CPU time
                process.kill()
                break
            time.sleep(0.002)
        return process.wait()


def run_whole(command: list[str], log: Path, config: Path) -> tuple[int, float, float]:
    """Exit code of a command, and its CPU time until it had written ``config`` and in all."""
    first = last = 0.0
    with open(log, "wb") as file, started(command, file) as process:
        while process.poll() is None:
            last = max(last, cpu_time(process.pid))
            first = first if config.exists() else last
            time.sleep(0.02)
    return process.returncode, first, last


def started(command: list[str], log: Any) -> subprocess.Popen:
    """A process that writes to ``log``."""
    environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ}
    return subprocess.Popen(bound(command, signal.SIGKILL), stdout=log, stderr=log, env=environment)


def cpu_time(pid: int) -> float:
    """Seconds of CPU time that a process has had (Linux): a moment in a run, however busy the machine is."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def state_of(run: Path) -> str:
    """Where a killed run was, as far as its files tell."""
    if not (run / "config.yml").exists():
        return "before the run began"
    saved = sorted(path.stem for path in run.glob("nerfstudio_models/*.ckpt"))
    unfinished = sorted(path.name for path in run.rglob(".*.part"))
    stages = sorted(path.name.split("-")[0] for path in run.glob("prepared/stages/*/*.pt"))
    words = [f"checkpoint {saved[-1]}" if saved else "no checkpoint yet"]
    if unfinished:
        words.append(f"while {unfinished[0]} was written")
    if stages:
        words.append(f"{len(stages)} stages kept")
    return ", ".join(words)


def differences(whole: Path, run: Path) -> list[str]:
    """What of two complete runs is not the same bits."""
    found = []
    checkpoints = [sorted(folder.glob("nerfstudio_models/*.ckpt")) for folder in (whole, run)]
    if [[path.name for path in paths] for paths in checkpoints] != [[checkpoints[0][0].name]] * 2:
        return [f"checkpoints: {[str(path) for path in checkpoints[1]]}"]
    one, other = (without_clocks(torch.load(paths[0], weights_only=True)) for paths in checkpoints)
    found += compare(one, other, "checkpoint")
    curves = [without_clocks(json.loads((folder / "held_out.json").read_text())) for folder in (whole, run)]
    found += compare(*curves, "curve")
    for file in sorted(path.relative_to(whole) for path in whole.glob("prepared/**/*.png")):
        if not (run / file).exists() or (whole / file).read_bytes() != (run / file).read_bytes():
            found.append(str(file))
    for file in sorted(path.relative_to(whole) for path in whole.glob("prepared/**/grid.pt")):
        found += compare(*(torch.load(folder / file, weights_only=True) for folder in (whole, run)), str(file))
    return found


def without_clocks(value: Any) -> Any:
    """The same without what a clock said."""
    if isinstance(value, dict):
        clocks = ("seconds", "cpu_seconds", "clocks")
        return {name: without_clocks(item) for name, item in value.items() if name not in clocks}
    return [without_clocks(item) for item in value] if isinstance(value, (list, tuple)) else value


def compare(one: Any, other: Any, where: str) -> list[str]:
    """Where two nested values are not the same bits."""
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        return [] if one.dtype == other.dtype and torch.equal(one, other) else [where]
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        return [found for key in one for found in compare(one[key], other[key], f"{where}/{key}")]
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        pairs = enumerate(zip(one, other, strict=True))
        return [found for index, pair in pairs for found in compare(*pair, f"{where}/{index}")]
    return [] if one == other else [where]


if __name__ == "__main__":
    sys.exit(main())
