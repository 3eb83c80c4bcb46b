"""Everything that reads files of strangers takes them or refuses them in a sentence, for some changed files of each.

More of them: ``python scripts/fuzz_parsers.py``.
"""

from __future__ import annotations

import sys
from itertools import islice
from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")
sys.path.insert(0, str(Path(__file__).parent.parent / "scripts"))
fuzz_parsers = pytest.importorskip("fuzz_parsers")

from parser_targets import TARGETS

COUNT = {"transforms.json": 60, "experiment": 60, "run config": 40, "checkpoint": 100, "checkpoint pickle": 100}


@pytest.mark.parametrize("name", TARGETS)
def test_changed_files_are_taken_or_refused(name):
    contents = islice(fuzz_parsers.changed(TARGETS[name].seeds(), 1), COUNT.get(name, 200))
    assert [failure for failure in (fuzz_parsers.failure_of(name, content) for content in contents) if failure] == []
