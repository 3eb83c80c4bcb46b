"""The notebook: its commands work, and what it shows tells nothing of the machine that ran it."""

from __future__ import annotations

import json
import re

import pytest
from places import ROOT
from test_documented_commands import check_beags, folder, words_of  # noqa: F401 (a fixture)

NOTEBOOK = ROOT / "docs/try_it.ipynb"
if not NOTEBOOK.exists():
    pytest.skip("no documents beside the tests", allow_module_level=True)
CELLS = json.loads(NOTEBOOK.read_text("utf8"))["cells"]
CODE = ["".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "code"]
COMMANDS = [line[1:].partition(" >")[0] for code in CODE for line in code.splitlines() if line.startswith("!beags ")]


@pytest.mark.parametrize("line", COMMANDS)
def test_its_commands_work(folder, monkeypatch, line):  # noqa: F811
    monkeypatch.chdir(folder)
    for name, value in {"{data}": "", "{run}": "run/config.yml", "{FOLDER}": "."}.items():
        line = line.replace(name, value)
    program, *words = words_of(line)
    assert program == "beags"
    check_beags(words)


def test_it_was_run_from_top_to_bottom():
    counts = [cell["execution_count"] for cell in CELLS if cell["cell_type"] == "code"]
    assert len(COMMANDS) == 3 and counts == list(range(1, len(counts) + 1))
    outputs = [output for cell in CELLS for output in cell.get("outputs", ())]
    assert not [output for output in outputs if output["output_type"] == "error"]
    assert sum("image/jpeg" in output.get("data", ()) for output in outputs) == 2


def test_it_is_small_and_tells_no_paths():
    assert NOTEBOOK.stat().st_size < 300_000
    texts = ["".join(output.get("text", "")) for cell in CELLS for output in cell.get("outputs", ())]
    assert texts and not re.search(r"(^|\s)/\w+/", "\n".join(texts))
