"""Kill runs at random moments with SIGKILL, go on, and compare: do they end bit for bit as without the kill?

    python tests/soak/kill_test.py --kills 50 --json kills.json

Trains a short run of beags-tiny on a small generated sample, and exports it, once without a kill. Then, again and
again, the same is begun in a folder of its own, killed, and done again or resumed (and sometimes killed once more):

- anywhere: at a random moment of the training, before its first file too;
- step: in a random step of the training, or soon after it;
- checkpoint: after a random number of a checkpoint's bytes are written, or all, before it takes its place;
- preparation: between base and refinement;
- export: ``beags export`` of all objects, splats and meshes, at a random moment;
- exported file: the same, while it writes a random one of its files. After both, what lies in its folder must be whole.

Compared are the checkpoints with the optimizers' state, the base, the masks, the voxel grids, the exported files.
Random moments are counted in CPU time, so that a busy machine changes nothing (Linux). All are forks of this process,
which imports everything once. Exit status 1: something differed.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(ROOT / "tests/support"), str(Path(__file__).resolve().parent)]
import forked  # noqa: E402
import same_bits  # noqa: E402

OPTIONS = {
    "pipeline.model.base_steps": 80, "pipeline.model.refine_steps": 30,
    "pipeline.model.densify.start": 20, "pipeline.model.densify.stop": 70, "pipeline.model.densify.every": 20,
    "pipeline.model.densify.max_surfels": 2500, "pipeline.model.prepare.k": 200, "steps_per_save": 5,
    "vis": "tensorboard",
}  # fmt: skip
FORMATS = ("ply", "ply-2dgs", "compressed-ply", "sog", "spz", "html", "glb", "obj", "stl", "3mf")  # usdz needs an extra
EXPORT = ("--all", "--format", *FORMATS, "--scale-by", "0,0,0 1,0,0 1 m", "--resolution", "32", "--min-views", "1")
EXPORTS = ANY_TIME, IN_A_FILE = "export", "exported file"
KINDS = ("step", "checkpoint", "anywhere", ANY_TIME, "step", "preparation", "anywhere", IN_A_FILE)  # They take turns.
CHECKPOINTS = 20  # about as many as a run writes
STEPS = OPTIONS["pipeline.model.base_steps"] + OPTIONS["pipeline.model.refine_steps"]
STEP_SECONDS = 0.05  # about what a slow step takes
ATTEMPTS = 20  # tries of one kind of kill, as a run may end before its moment comes


class Tester:
    """Runs without a kill in ``folder``, and runs with kills that are compared with them.

    seconds: CPU time of the training and of the export; preparation: from and to when, of the training's.
    """

    def __init__(self, folder: Path, seed: int, again: float) -> None:
        self.folder, self.again = folder, again
        self.moments = random.Random(seed)
        self.data, self.whole = folder / "data", folder / "whole"
        self.exported = folder / "whole_export"
        self.run_seconds = self.export_seconds = 0.0
        self.preparation = 0.0, 0.0
        self.kills: list[dict] = []
        self.trials = self.wrong = 0

    def without_kill(self) -> None:
        """Make what is compared with; raises ``RuntimeError`` if that fails."""
        log = self.folder / "whole.log"
        if forked.run(lambda: write_data(self.data), log) != 0:
            raise RuntimeError(f"the sample could not be written: {log}")
        seen: dict[str, float] = {}
        child = forked.forked(lambda: train(self.data, self.whole), log)
        before = f"nerfstudio_models/step-{OPTIONS['pipeline.model.base_steps'] - 1:09d}.ckpt"  # saved as it begins
        marks = {"begin": self.whole / before, "grid": self.whole / "prepared/grid.pt"}
        while (code := forked.ended(child)) is None:
            self.run_seconds = max(self.run_seconds, forked.cpu_time(child))
            for name, path in marks.items():
                if name not in seen and path.exists():
                    seen[name] = self.run_seconds
            time.sleep(0.005)
        self.preparation = seen["begin"], seen["grid"]
        exporting = forked.kill_after(lambda: export(self.whole, self.exported), log, float("inf"))
        export_code, self.export_seconds = exporting
        if code != 0 or export_code != 0:
            raise RuntimeError(f"the run without a kill ended with exit codes {code}, {export_code}: {log}")

    def trial(self, kind: str) -> None:
        """Kill once or more, go on to the end, compare; findings go to ``kills``."""
        place = self.folder / f"{self.trials}_{kind}"
        self.trials += 1
        found = self._killed_export(kind, place) if kind in EXPORTS else self._killed_run(kind, place)
        self.wrong += bool(found)
        self.kills[-1]["differs"] = found
        print(f"{self.kills[-1]['at']}: {'; '.join(found[:3]) or 'the same bits'}", flush=True)
        if not found:
            shutil.rmtree(place)

    def _killed_run(self, kind: str, run: Path) -> list[str]:
        log, killed = self.folder / f"{run.name}.log", 0
        while not killed or (self.moments.random() < self.again and not is_complete(run)):
            code = self._kill(kind if not killed else "anywhere", run, log)
            if code == -signal.SIGKILL:
                killed += 1
                self.kills.append({"kind": kind if killed == 1 else "resumed", "at": f"{kind}: {state_of(run)}"})
            elif code != 0:
                self.kills.append({"kind": kind, "at": f"{kind}: ended by itself, {state_of(run)}"})
                return [f"ended with exit code {code}: {log}"]
            elif not killed:
                shutil.rmtree(run)  # it was done before the moment came
        if not is_complete(run) and (code := forked.run(lambda: go_on(self.data, run), log)) != 0:
            return [f"going on ended with exit code {code}: {log}"]
        return self._compared(lambda: same_bits.run_differences(self.whole, run))

    def _kill(self, kind: str, run: Path, log: Path) -> int:
        """Kill a run, if its moment comes; return its exit code."""
        if kind == "checkpoint":
            number, share = self.moments.randint(1, CHECKPOINTS), self.moments.uniform(0.0, 1.2)

            def ending() -> None:
                with forked.killed_in_write(".ckpt", number, share):
                    go_on(self.data, run)

            return forked.run(ending, log)
        if kind == "step":
            from beags_plugin.plugin.trainer import BeagsTrainer

            step, seconds = self.moments.randint(1, STEPS), self.moments.uniform(0.0, STEP_SECONDS)

            def training() -> None:
                with forked.killed_in_call(BeagsTrainer, "train_iteration", step, seconds):
                    go_on(self.data, run)

            return forked.run(training, log)
        from_, to = self.preparation if kind == "preparation" else (0.0, self.run_seconds)
        return forked.kill_after(lambda: go_on(self.data, run), log, self.moments.uniform(from_, to))[0]

    def _killed_export(self, kind: str, folder: Path) -> list[str]:
        log, call = self.folder / f"{folder.name}.log", lambda: export(self.whole, folder)
        for _ in range(ATTEMPTS):
            if self._kill_export(kind, call, log) == -signal.SIGKILL:
                break
            shutil.rmtree(folder, ignore_errors=True)
        else:
            raise RuntimeError(f"an export cannot be killed: {log}")
        whole = sum(path.is_file() for path in self.exported.rglob("*"))
        there = sum(path.is_file() and not path.name.startswith(".") for path in folder.rglob("*"))
        at = f"{kind}: {there} of {whole} files there"
        if unfinished := [path.name for path in folder.rglob(".*.part")]:
            at += f", while {unfinished[0]} was written"
        self.kills.append({"kind": kind, "at": at})
        found = self._compared(lambda: same_bits.half_written(self.exported, folder))
        if (code := forked.run(call, log)) != 0:
            return [*found, f"the second export ended with exit code {code}: {log}"]
        return found + self._compared(lambda: same_bits.export_differences(self.exported, folder))

    def _kill_export(self, kind: str, call: Callable[[], None], log: Path) -> int:
        """Kill an export, if its moment comes; return its exit code."""
        if kind == ANY_TIME:
            return forked.kill_after(call, log, self.moments.uniform(0.0, self.export_seconds))[0]
        files = sum(path.is_file() for path in self.exported.rglob("*"))
        number, share = self.moments.randint(1, files), self.moments.uniform(0.0, 1.2)

        def ending() -> None:
            with forked.killed_in_write("", number, share):
                call()

        return forked.run(ending, log)

    def _compared(self, call: Callable[[], list[str]]) -> list[str]:
        """Return what ``call`` finds, in a process of its own."""
        answer, log = self.folder / "answer.json", self.folder / "compare.log"
        code = forked.run(lambda: answer.write_text(json.dumps(call())), log)
        return json.loads(answer.read_text()) if code == 0 else [f"the comparison failed: {log}"]


def main() -> int:
    """Parse arguments, kill, report; returns the exit code."""
    from beags_benchmarks.provenance import commit, describe_machine

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=8, help="how many kills, at least")
    parser.add_argument("--again", type=float, default=0.2, help="share of resumes that are killed too")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--output", type=Path, default=Path("outputs/kill_test"), help="folder for everything")
    parser.add_argument("--json", type=Path, default=None, help="file for what was found")
    arguments = parser.parse_args()
    output, start = arguments.output.absolute(), time.monotonic()
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir(parents=True)
    import_everything()
    tester = Tester(output, arguments.seed, arguments.again)
    tester.without_kill()
    begin, end = tester.preparation
    print(f"without a kill: {tester.run_seconds:.1f} s of CPU time (preparation {begin:.1f} to {end:.1f} s), export "
          f"{tester.export_seconds:.1f} s", flush=True)  # fmt: skip
    while len(tester.kills) < arguments.kills:
        tester.trial(KINDS[tester.trials % len(KINDS)])
        report = {
            "kills": len(tester.kills), "runs": tester.trials, "runs_that_differ": tester.wrong,
            "by_kind": Counter(kill["kind"] for kill in tester.kills),
            "cpu_seconds_of_run": tester.run_seconds, "cpu_seconds_of_export": tester.export_seconds,
            "seed": arguments.seed, "seconds": time.monotonic() - start, "commit": commit(),
            "machine": describe_machine(), "moments": tester.kills,
        }  # fmt: skip
        (arguments.json or output / "kill_test.json").write_text(json.dumps(report, indent=1))
    print(f"{len(tester.kills)} kills in {tester.trials} runs; {tester.wrong} runs differ from the whole one.")
    return int(tester.wrong > 0)


def import_everything() -> None:
    """Import what a run needs, but compute nothing: threads would not survive the forks."""
    from nerfstudio.scripts import train  # noqa: F401

    from beags_plugin.commands import cli  # noqa: F401
    from beags_plugin.objects import export  # noqa: F401
    from beags_plugin.ops import extension
    from beags_plugin.plugin import (
        launch,  # noqa: F401
        methods,  # noqa: F401
    )
    from beags_plugin.sample import writer  # noqa: F401

    extension.load()


def write_data(folder: Path) -> None:
    """Write the sample at a quarter of its size."""
    from beags_plugin.sample.writer import SampleConfig, write_sample

    write_sample(folder, SampleConfig(seed=3, width=96, height=72, num_train=10, num_test=2))


def train(data: Path, run: Path) -> None:
    """Train as ns-train does once it has read its arguments."""
    from beags_plugin.plugin.launch import train
    from beags_plugin.plugin.presets import preset_config

    config = preset_config("beags-tiny", OPTIONS, Path("kill_test.py"))
    config.data, config.run_dir = data, run
    train(config)


def go_on(data: Path, run: Path) -> None:
    """Begin a run, or do what ``beags resume`` does with one that has begun."""
    from beags_plugin.commands.cli import main

    if (run / "config.yml").exists():
        main(["resume", str(run)])
    else:
        train(data, run)


def export(run: Path, folder: Path) -> None:
    """Export as ``beags export`` does."""
    from beags_plugin.commands.cli import main

    main(["export", "--load-config", str(run / "config.yml"), "--output", str(folder), *EXPORT])


def is_complete(run: Path) -> bool:
    """Return whether a run has ended by itself."""
    return (run / "training.json").exists()


def state_of(run: Path) -> str:
    """Return where a killed run was, as far as its files show."""
    if not (run / "config.yml").exists():
        return "before the run began"
    saved = sorted(path.stem for path in run.glob("nerfstudio_models/*.ckpt"))
    unfinished = sorted(path.name for path in run.rglob(".*.part"))
    words = [saved[-1] if saved else "no checkpoint yet"]
    if unfinished:
        words.append(f"while {unfinished[0]} was written")
    return ", ".join(words)


if __name__ == "__main__":
    sys.exit(main())
