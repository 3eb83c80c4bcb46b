"""Changed files for everything that reads files of any origin: it must take them, or refuse them in one sentence.

    python tests/soak/fuzz_parsers.py --seconds 600                      # every parser for 10 minutes
    python tests/soak/fuzz_parsers.py --target ply mask --seconds 60     # some of them
    python tests/soak/fuzz_parsers.py --count 300 --seed 0               # 300 files each, always the same

With --seconds, atheris (``pip install atheris``) chooses what to change by which lines a file reaches; where it is not
installed, and with --count, files are changed at random. A parser that raises anything but ``UserError``, takes more
than 20 seconds of CPU time or asks for more than 4 GB of memory is a finding: its file is kept and named. Exit status
1: findings.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).resolve().parent)]

NAMES = (
    "ply", "seed points", "npy poses", "colmap images", "colmap cameras", "colmap points", "transforms.json",
    "classes.json", "coco", "prompts", "experiment", "run config", "checkpoint", "checkpoint pickle", "voxel grid",
    "mask", "mask rows",
)  # fmt: skip
SECONDS = 20  # seconds of CPU time for one file
STUCK = 600  # seconds of wall time after which atheris takes a parser to be stuck
MEMORY = 4 << 30  # bytes beyond what the libraries take
LONGEST = 1 << 14  # bytes of a changed file
NUMBERS = (0, 1, 127, 128, 255, 256, 32767, 65535, 65536, 1 << 31, (1 << 32) - 1, 1 << 40, 1 << 60, (1 << 64) - 1)
WORDS = (b"nan", b"inf", b"-1", b"1e999", b"null", b"[", b"{", b'"', b"\n", b"\0", b"99999999999999999999", b"true")
INSTRUMENTED = ["beags_plugin", "yaml", "json", "zipfile"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--target", nargs="+", default=list(NAMES), choices=NAMES, metavar="NAME", help=", ".join(NAMES)
    )
    parser.add_argument("--seconds", type=float, help="of every parser")
    parser.add_argument("--count", type=int, help="files of every parser, changed at random")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="file for what was done")
    parser.add_argument("--findings", type=Path, default=Path("outputs/fuzz_parsers"), help="folder of files that fail")
    options = parser.parse_args()
    if (options.seconds is None) == (options.count is None):
        parser.error("give --seconds or --count")
    done, failed = {}, False
    for name in options.target:
        if options.seconds is not None and find_spec("atheris") is not None:
            found = in_a_process(name, options)
        else:
            found = at_random(name, options)
        done[name] = found
        failed |= bool(found["finding"])
        told = f"FINDING {found['finding']}" if found["finding"] else "no finding"
        print(f"{name}: {found['files']:,} files in {found['seconds']:.0f} s ({found['engine']}), {told}", flush=True)
        if options.json:
            options.json.write_text(json.dumps(done, indent=1))
    return int(failed)


def at_random(name: str, options: argparse.Namespace) -> dict:
    """Try files changed at random, until their number or the time is over, or one fails."""
    from parser_targets import TARGETS

    start, tried = time.monotonic(), 0
    for content in changed(TARGETS[name].seeds(), options.seed):
        over = options.seconds is not None and time.monotonic() - start > options.seconds
        if over or tried == options.count:
            break
        tried += 1
        if failure := failure_of(name, content):
            path = keep(options.findings, name, content)
            return record("random", tried, start, f"{path}\n{failure}")
    return record("random", tried, start, "")


def record(engine: str, files: int, start: float, finding: str) -> dict:
    return {"engine": engine, "files": files, "seconds": time.monotonic() - start, "finding": finding}


def keep(folder: Path, name: str, content: bytes) -> Path:
    """Write a file that fails."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name.replace(' ', '_')}-{abs(hash(content)) % 10**8}"
    path.write_bytes(content)
    return path


def failure_of(name: str, content: bytes) -> str | None:
    """Describe how a parser fails on a file; None if it takes or refuses it."""
    from parser_targets import TARGETS, examine

    try:
        with limited():
            examine(TARGETS[name], content)
    except Exception:
        return traceback.format_exc()
    return None


@contextmanager
def limited() -> Iterator[None]:
    """Raise ``TimeoutError`` in what takes more CPU time than ``SECONDS``: a busy machine changes nothing."""

    def late(*_: object) -> None:
        raise TimeoutError(f"more than {SECONDS} s")

    former = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, former)


def changed(seeds: list[bytes], seed: int):
    """Yield the seeds, then files made of them, without end; the same for the same seed."""
    yield from seeds
    chance = random.Random(seed)
    kept = list(seeds)
    while True:
        content = bytearray(chance.choice(kept))
        for _ in range(chance.choice((1, 1, 1, 2, 4))):
            chance.choice(CHANGES)(content, chance, kept)
        yield bytes(content[:LONGEST])


def _flip(content: bytearray, chance: random.Random, _: list[bytes]) -> None:
    if content:
        content[chance.randrange(len(content))] = chance.randrange(256)


def _cut(content: bytearray, chance: random.Random, _: list[bytes]) -> None:
    start = chance.randrange(len(content) + 1)
    del content[start : start + chance.choice((1, 1, 4, 16, LONGEST))]


def _repeat(content: bytearray, chance: random.Random, _: list[bytes]) -> None:
    start = chance.randrange(len(content) + 1)
    content[start:start] = content[start : start + chance.choice((1, 4, 16, 64))] * chance.choice((1, 2, 50))


def _number(content: bytearray, chance: random.Random, _: list[bytes]) -> None:
    length, order = chance.choice((1, 2, 4, 8)), chance.choice(("little", "big"))
    value = chance.choice(NUMBERS) % (1 << 8 * length)
    start = chance.randrange(len(content) + 1)
    content[start : start + length] = value.to_bytes(length, order)  # type: ignore[arg-type]


def _word(content: bytearray, chance: random.Random, _: list[bytes]) -> None:
    start = chance.randrange(len(content) + 1)
    content[start : start + chance.choice((0, 1, 3))] = chance.choice(WORDS)


def _digits(content: bytearray, chance: random.Random, _: list[bytes]) -> None:
    found = list(re.finditer(rb"-?\d+(\.\d+)?", content))
    if found:
        match = chance.choice(found)
        content[match.start() : match.end()] = chance.choice(
            (*WORDS[:5], b"0", b"-3", b"65536", b"4294967296", b"9" * 30)
        )


def _splice(content: bytearray, chance: random.Random, kept: list[bytes]) -> None:
    other = chance.choice(kept)
    start, end = sorted(chance.randrange(len(other) + 1) for _ in range(2))
    at = chance.randrange(len(content) + 1)
    content[at:at] = other[start:end]


CHANGES: tuple[Callable[[bytearray, random.Random, list[bytes]], None], ...]
CHANGES = (_flip, _flip, _cut, _repeat, _number, _number, _word, _digits, _digits, _splice)


# -- with atheris ----------------------------------------------------------------------------------------------------


def in_a_process(name: str, options: argparse.Namespace) -> dict:
    """Let atheris look for files that fail, in a copy of this process, which it may end."""
    instrumented()
    start = time.monotonic()
    work = (options.findings / f"work_{name.replace(' ', '_')}").absolute()
    shutil.rmtree(work, ignore_errors=True)
    (work / "corpus").mkdir(parents=True)
    if (child := os.fork()) == 0:
        with open(work / "log.txt", "wb") as log:
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
        guided(name, work, options)
        os._exit(0)
    ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    told = (work / "log.txt").read_text(errors="replace")
    counts = re.findall(r"number_of_executed_units: (\d+)", told) or re.findall(r"^#(\d+)", told, re.MULTILINE)
    finding = ""
    if ended != 0:
        kept = [str(path) for path in work.iterdir() if path.is_file() and path.name != "log.txt"]
        finding = f"{' '.join(kept)}\n{told[-4000:]}"
    return record("atheris", int(counts[-1]) if counts else 0, start, finding)


@lru_cache(None)
def instrumented() -> None:
    """Import the parsers so that atheris sees which of their lines run; each reads its seeds, and imports the rest."""
    import atheris  # pyright: ignore[reportMissingImports]  (installed on demand)

    with atheris.instrument_imports(include=INSTRUMENTED, enable_loader_override=False):
        from parser_targets import TARGETS, examine

        for target in TARGETS.values():
            for content in target.seeds():
                examine(target, content)


def guided(name: str, work: Path, options: argparse.Namespace) -> None:
    """Run the process of one parser under atheris; never return."""
    import atheris  # pyright: ignore[reportMissingImports]
    from parser_targets import TARGETS, examine

    target = TARGETS[name]
    for number, content in enumerate(target.seeds()):
        (work / "corpus" / f"seed{number}").write_bytes(content)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    command = [sys.argv[0], str(work / "corpus"), f"-max_total_time={options.seconds:.0f}", f"-artifact_prefix={work}/"]
    command += [f"-timeout={STUCK}", "-rss_limit_mb=16384", f"-max_len={LONGEST}", "-print_final_stats=1"]

    def once(content: bytes) -> None:
        with limited():
            examine(target, content)

    atheris.Setup([*command, f"-seed={options.seed + 1}"], once)
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main())
