"""Time the answers of commands: the goals are 2 s for refusing a mistake and 3 s for the first output.

Commands on a finished run should begin their work within 3 s of CPU, and exports of the demo should need no more than
``EXPORTS``. CPU seconds are those of the process and its children, which a busy machine hardly changes; peak memory is
that of the largest of them. Every command runs in its own terminal (a pty), after one start that fills the file cache.
"""

from __future__ import annotations

import argparse
import json
import os
import pty
import re
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic

REFUSED, SHOWN = 2.0, 3.0  # seconds, the goals
BEGUN = 3.0  # seconds of CPU until a command on a finished run begins its work
_UNSEEN = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|starting|[\s⠀-⣿]")  # codes of terminals, and the spinner of the start

_FIRST_OBJECT = """
import sys
from pathlib import Path
from beags_plugin.commands.starting import run_config
from beags_plugin.objects.extract import chosen_objects
from beags_plugin.runs.run import Run
run = Run(run_config(Path(sys.argv[1])))
print(next(iter(chosen_objects(run.assigned, (), run.folder))))
"""
MISTAKES = {  # commands that must be refused at once
    "beags masks check --data nowhere": "",
    "beags masks make --data {tmp} --source grabcat": "",
    "beags extract --load-config absent.yml": "",
    "beags export --load-config {run} --all --format stl": "run",
    "beags render --load-config {run} --format sheets": "run",
    "beags eval --load-config absent.yml": "",
    "beags resume absent.yml": "",
    "beags demo --preset beags-fats": "",
    "beags doctor --data nowhere": "",
    "ns-train beags-tiny --data nowhere": "",
}
WORK = {  # commands that must show at once that they have begun
    "beags --help": "",
    "beags doctor": "",
    "beags masks check --data {data} --output {tmp}/check": "data",
    "beags extract --load-config {run} --output {tmp}/extracted": "run",
    "beags export --load-config {run} --all --output {tmp}/exports": "run",
    "beags render --load-config {run} --format sheet --output {tmp}/sheet.png": "run",
    "beags eval --load-config {run}": "run",
    "ns-train beags --help": "",
}
EXPORTS = {  # exports of the demo, to seconds of CPU
    "beags export --load-config {run} --object {object} --format ply --output {tmp}/ply": 4.0,
    "beags export --load-config {run} --object {object} --format glb --output {tmp}/glb": 10.0,
    "beags export --load-config {run} --all --format ply glb --output {tmp}/all": 60.0,
}
OF_RUNS = {  # commands that must begin their work within ``BEGUN``
    "beags masks reproject --load-config {run} --output {tmp}/reprojected": "run",
    "beags masks check --load-config {run} --output {tmp}/checked": "run",
    **{command: "run" for command, needs in WORK.items() if needs == "run"},
    **dict.fromkeys(EXPORTS, "run"),
}


@dataclass
class Answer:
    """Seconds until the first visible character, and until the end; the command's exit code.

    begun: seconds of CPU until the first output after the start message. cpu: until the end. memory: peak in MB.
    """

    command: str
    first: float
    end: float
    code: int
    begun: float
    cpu: float
    memory: float


def answer(command: str, words: list[str]) -> Answer:
    """Run a command of this environment in a terminal and time it."""
    words = [str(Path(sys.executable).parent / words[0]), *words[1:]]
    controller, terminal = pty.openpty()
    began, first, begun = monotonic(), None, None
    process = subprocess.Popen(words, stdin=terminal, stdout=terminal, stderr=terminal)
    os.close(terminal)
    try:
        while text := os.read(controller, 65536):
            if first is None and text.strip():
                first = monotonic() - began
            if begun is None and _UNSEEN.sub("", text.decode("utf8", "replace")):
                begun = _cpu_of(process.pid)
    except OSError:  # the terminal is closed
        pass
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    os.close(controller)
    end, cpu = monotonic() - began, used.ru_utime + used.ru_stime
    whole = cpu if begun is None else begun
    memory = used.ru_maxrss * 1024 / 1e6  # On Linux at least that of this process, which therefore loads no torch.
    return Answer(command, end if first is None else first, end, process.returncode, whole, cpu, memory)


def _cpu_of(process: int) -> float:
    """Return the CPU seconds of a process so far; on Linux only."""
    words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def first_object(run: Path) -> str:
    """Return the first object of a run (its folder, or config.yml in it) that has Gaussians."""
    done = subprocess.run([sys.executable, "-c", _FIRST_OBJECT, str(run)], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"the objects of {run} cannot be read, so name one with --object:\n{done.stderr}")
    return done.stdout.splitlines()[-1]


def main() -> None:
    """Print a line for each command: the least seconds and memory of all rounds, and whether the goal is met."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, help="a trained run, for the commands that need one")
    parser.add_argument("--data", type=Path, help="a scene, for the commands that need one")
    parser.add_argument("--object", help="an object of the run; its first one if left out")
    parser.add_argument("--only", default="", help="run the commands that hold this text")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    rows = []
    if options.run is not None and options.object is None:
        options.object = first_object(options.run)
        print(f"object: {options.object}")
    with tempfile.TemporaryDirectory() as folder:
        named = {"tmp": folder, "run": str(options.run), "data": str(options.data), "object": options.object}
        for command, needs in (MISTAKES | WORK | OF_RUNS).items():
            if options.only not in command:
                continue
            if needs and getattr(options, needs) is None:
                print(f"{'not run':>8}  {command}: give --{needs}")
                continue
            words = [word.format(**named) for word in command.split()]
            answer(command, words)
            rounds = [answer(command, words) for _ in range(options.rounds)]
            names = ("first", "end", "begun", "cpu", "memory")
            least = {name: min(getattr(one, name) for one in rounds) for name in names}
            best = Answer(command, code=rounds[0].code, **least)
            refusal = command in MISTAKES
            met = best.first <= SHOWN and (best.end <= REFUSED and best.code == 2 if refusal else best.code == 0)
            if command in OF_RUNS:
                met &= best.begun <= BEGUN and best.cpu <= EXPORTS.get(command, best.cpu)
            end = f"refused {best.end:5.1f} s" if refusal else f"end     {best.end:5.1f} s"
            cpu = f"begun {best.begun:4.1f}  all {best.cpu:5.1f} s of CPU  peak {best.memory:5.0f} MB"
            print(f"{'met' if met else 'MISSED':>8}  first {best.first:5.1f} s  {end}  {cpu}  {command}", flush=True)
            rows.append(asdict(best) | {"met": met})
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
