"""Time how soon the commands answer: a mistake is to be refused within 2 s, and something shown within 3 s.

Every command runs in a terminal of its own (a pty), as a user has one, after one start that fills the file cache.
"""

from __future__ import annotations

import argparse
import json
import os
import pty
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic

REFUSED, SHOWN = 2.0, 3.0  # seconds, the goals

MISTAKES = {  # refused at once
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
WORK = {  # shows at once that it has begun
    "beags --help": "",
    "beags doctor": "",
    "beags masks check --data {data} --output {tmp}/check": "data",
    "beags extract --load-config {run} --output {tmp}/extracted": "run",
    "beags export --load-config {run} --all --output {tmp}/exports": "run",
    "beags render --load-config {run} --format sheet --output {tmp}/sheet.png": "run",
    "beags eval --load-config {run}": "run",
    "ns-train beags --help": "",
}


@dataclass
class Answer:
    """Seconds until the first visible character, and until the end; the command's exit code."""

    command: str
    first: float
    end: float
    code: int


def answer(command: str, words: list[str]) -> Answer:
    """Run a command of this environment in a terminal and time it."""
    words = [str(Path(sys.executable).parent / words[0]), *words[1:]]
    controller, terminal = pty.openpty()
    began, first = monotonic(), None
    with subprocess.Popen(words, stdin=terminal, stdout=terminal, stderr=terminal) as process:
        os.close(terminal)
        try:
            while text := os.read(controller, 65536):
                if first is None and text.strip():
                    first = monotonic() - began
        except OSError:  # the terminal is closed
            pass
    os.close(controller)
    end = monotonic() - began
    return Answer(command, end if first is None else first, end, process.returncode)


def main() -> None:
    """Print a line per command: the least seconds of all rounds, and whether the goal is met."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, help="a trained run, for the commands that need one")
    parser.add_argument("--data", type=Path, help="a scene, for the commands that need one")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    found = []
    with tempfile.TemporaryDirectory() as folder:
        named = {"tmp": folder, "run": str(options.run), "data": str(options.data)}
        for command, needs in (MISTAKES | WORK).items():
            if needs and getattr(options, needs) is None:
                print(f"{'not run':>8}  {command}: give --{needs}")
                continue
            words = [word.format(**named) for word in command.split()]
            answer(command, words)
            rounds = [answer(command, words) for _ in range(options.rounds)]
            best = Answer(command, min(one.first for one in rounds), min(one.end for one in rounds), rounds[0].code)
            refusal = command in MISTAKES
            met = best.first <= SHOWN and (best.end <= REFUSED and best.code == 2 if refusal else best.code == 0)
            end = f"refused {best.end:5.1f} s" if refusal else f"end     {best.end:5.1f} s"
            print(f"{'met' if met else 'MISSED':>8}  first {best.first:5.1f} s  {end}  {command}", flush=True)
            found.append(asdict(best) | {"met": met})
    if options.json is not None:
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
