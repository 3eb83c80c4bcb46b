"""Everything that reads files of strangers takes them or refuses them in a sentence, for some changed files of each.

More of them: ``python tests/soak/fuzz_parsers.py``.
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")
fuzz_parsers = pytest.importorskip("fuzz_parsers")

from parser_targets import TARGETS, Target, examine

COUNT = {"transforms.json": 60, "experiment": 60, "run config": 40, "checkpoint": 100, "checkpoint pickle": 100}


@pytest.mark.parametrize("name", TARGETS)
def test_changed_files_are_taken_or_refused(name):
    contents = islice(fuzz_parsers.changed(TARGETS[name].seeds(), 1), COUNT.get(name, 200))
    assert [failure for failure in (fuzz_parsers.failure_of(name, content) for content in contents) if failure] == []


def test_the_files_to_begin_with_are_good():
    for name, target in TARGETS.items():
        told = [examine(target, content) for content in target.seeds()]
        assert None in told or name in ("run config", "seed points"), told


def test_the_script_names_every_parser():
    assert tuple(TARGETS) == fuzz_parsers.NAMES


def test_the_same_seed_gives_the_same_files():
    first, again, other = (list(islice(fuzz_parsers.changed([b"abc", b"[1, 2]"], seed), 50)) for seed in (3, 3, 4))
    assert first == again != other


def test_a_parser_that_fails_is_noticed(monkeypatch):
    def read(path: Path) -> None:
        if b"x" in path.read_bytes():
            raise KeyError("x")

    monkeypatch.setitem(TARGETS, "mask", Target("a", read, lambda: [b"a"]))
    assert fuzz_parsers.failure_of("mask", b"a") is None
    assert "KeyError" in (fuzz_parsers.failure_of("mask", b"x") or "")


def test_a_parser_that_takes_forever_is_noticed(monkeypatch):
    def read(path: Path) -> None:
        while True:
            pass

    monkeypatch.setattr(fuzz_parsers, "SECONDS", 0.2)
    monkeypatch.setitem(TARGETS, "mask", Target("a", read, lambda: [b"a"]))
    assert "TimeoutError: more than 0.2 s" in (fuzz_parsers.failure_of("mask", b"a") or "")
