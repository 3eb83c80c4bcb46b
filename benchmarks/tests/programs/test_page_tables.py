"""Tables of the pages: every figure is one of the committed files'."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from places import ROOT

pytest.importorskip("nerfstudio")

from experiment_files import GOOD, written

from beags_benchmarks.experiments.experiment import Variant, load_experiment
from beags_benchmarks.experiments.results import FIGURES, ResultRow, report_json
from beags_benchmarks.studies import page_tables
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.system.errors import UserError

RESULTS = ROOT / "docs" / "results"
COSTS = {"rendered_iou_after": 0.75, "ssim_after": 0.875, "steps": 200, "cpu_seconds": 40.5,
         "cpu_seconds total": 90.25, "own_memory_mb": 300.5, "peak_memory_mb": 900.5}  # fmt: skip


def cells(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]


@pytest.mark.parametrize("table", page_tables.TABLES, ids=lambda table: table.name)
def test_a_page_has_the_figures_of_the_committed_files(table):
    """Looked up here by their own names, so that neither page nor program can go wrong alone."""
    text = (ROOT / table.page).read_text()
    shown = cells(text.partition(table.begin)[2].partition(page_tables.END)[0])
    sources = {file: json.loads((RESULTS / f"{file}.json").read_text()) for file, *_ in table.columns.values()}
    for source in sources.values():
        assert source["command"] and source["commit"] and source["machine"]["cpu"] and not source["quick"]
    assert shown[0] == [table.corner, *table.columns] and len(shown) - 2 == len(table.rows) <= page_tables.MOST_ROWS
    for name, line in zip(table.rows, shown[2:], strict=True):
        assert line[0].strip("`") == name
        for (file, scene, (figure, digits, factor)), cell in zip(table.columns.values(), line[1:], strict=True):
            rows = [row for row in sources[file]["rows"] if (row["variant"], row["scene"]) == (name, scene)]
            assert len({row["seed"] for row in rows}) == len(rows) > 0
            if figure == "error_left":
                error = 1 - np.mean([row["extracted_biou_after"] for row in rows])
                plain = [row for row in sources[file]["rows"] if row["variant"] == "assignment alone"]
                value = error / np.mean([1 - row["extracted_biou_after"] for row in plain if row["scene"] == scene])
            else:
                value = np.mean([row[figure] for row in rows])
            assert cell == f"{factor * value:.{digits}f}"


def test_readme_has_one_table_that_is_read_at_a_glance():
    (table,) = (table for table in page_tables.TABLES if table.page == "README.md")
    assert len(table.rows) <= 4 and len(table.columns) <= 4


def test_the_committed_pages_are_what_the_program_writes(tmp_path):
    pages = {table.page for table in page_tables.TABLES}
    for page in pages:
        (tmp_path / page).parent.mkdir(exist_ok=True)
        (tmp_path / page).write_text((ROOT / page).read_text())
    shutil.copytree(RESULTS, tmp_path / "docs/results")
    page_tables.main([], tmp_path)
    for page in pages:
        assert (tmp_path / page).read_text() == (ROOT / page).read_text(), page


def objects_of(place: int, figures: dict) -> dict[str, dict]:
    """Return figures of two objects; of the second, masks are empty in truth and as rendered."""
    return {
        "cup": {**figures, "extracted_biou_after": 0.8 + 0.0123456 * place},
        "box": {**figures, "extracted_biou_after": None},
    }


ROWS = ("assignment alone", "the paper's losses", "beags-fast", "beags-refine")
TABLE = page_tables.PageTable(
    "page.md",
    "one",
    "bear, digger",
    {
        "bear: BIoU": ("captures", "bear, salient", page_tables.BIOU),
        "bear: PSNR": ("captures", "bear, salient", page_tables.FITTED),
        "digger: spill": ("captures", "kitchen, salient", page_tables.SPILL),
        "digger: seconds": ("captures", "kitchen, salient", page_tables.SECONDS),
    },
    ROWS,
)
PAGE = f"# A page\n\n{TABLE.begin}old\n{page_tables.END}\nwords\n"


@pytest.fixture
def clone(tmp_path, monkeypatch):
    """A folder with one page and its table, and a fresh result of captures, with objects and a failure."""
    monkeypatch.setattr(page_tables, "TABLES", (TABLE,))
    (tmp_path / "docs/results").mkdir(parents=True)
    (tmp_path / "page.md").write_text(PAGE)
    experiment = load_experiment(written(tmp_path, GOOD))
    figures = {**dict.fromkeys(FIGURES), "extracted_iou_after": 0.91234567, "extracted_biou_after": 0.8,
               "worst_biou_after": 0.5, "psnr_fit_after": 30.126, "extracted_spill_after": 0.025, **COSTS}  # fmt: skip
    rows = [
        ResultRow(Variant(name), scene, 1, figures, objects_of(place, figures), protocol=Protocol(), truth="visible")
        for place, scene in enumerate(("bear, salient", "kitchen, salient", "fruit, given"))
        for name in ROWS[:3]
    ]
    for scene in ("bear, salient", "kitchen, salient", "fruit, given"):
        rows.append(ResultRow(Variant("beags-refine"), scene, 1, dict.fromkeys(FIGURES), {}, "no memory"))
    command = "beags bench captures --data-root /data/scenes --output /tmp/bench --scenes bear"
    source = {"command": command, "commit": "abc", "machine": {"cpu": "x"}, "torch": "2", "quick": False}
    (tmp_path / "captures.json").write_text(json.dumps(report_json(experiment, rows, source)))
    return tmp_path


def test_one_command_makes_the_tables_from_a_result(clone):
    page_tables.main([str(clone / "captures.json")], clone)
    kept = json.loads((clone / "docs/results/captures.json").read_text())
    assert kept["command"] == "beags bench captures --data-root scenes --scenes bear"
    assert kept["commit"] == "abc" and kept["machine"] == {"cpu": "x"}
    assert kept["protocol"].startswith("Protocol: extracted masks against visible masks, less")
    names = ["bear, salient", "kitchen, salient", "fruit, given"]
    scenes = [name for name in names for _ in range(3)] + names
    assert [row["scene"] for row in kept["rows"]] == scenes
    assert kept["rows"][9]["failed"] == "no memory" and "objects" not in kept["rows"][9]
    bious = [{"cup": biou, "box": None} for biou in (0.8, 0.8123, 0.8247) for _ in range(3)]
    assert [row["objects"] for row in kept["rows"][:9]] == bious and "objects" not in kept["means"][0]
    assert page_tables.reduced(kept) == kept
    assert kept["means"][0]["extracted_iou_after"] == 0.912346
    assert COSTS.items() <= kept["rows"][0].items() and COSTS.items() <= kept["means"][0].items()
    assert not COSTS.keys() & kept["rows"][9].keys()  # failed
    text = (clone / "page.md").read_text()
    figures = ["80.0", "30.13", "2.5", "40"]
    assert cells(text) == [
        ["bear, digger", "bear: BIoU", "bear: PSNR", "digger: spill", "digger: seconds"],
        ["---"] * 5,
        ["assignment alone", *figures],
        ["the paper's losses", *figures],
        ["`beags-fast`", *figures],
        ["`beags-refine`", *["failed"] * 4],
    ]
    assert text.startswith(f"# A page\n\n{TABLE.begin}") and text.endswith(f"{page_tables.END}\nwords\n")
    page_tables.main([f"again={clone / 'captures.json'}"], clone)
    assert (clone / "page.md").read_text() == text and (clone / "docs/results/again.json").exists()


def test_what_cannot_be_a_table_is_refused(clone):
    page_tables.main([str(clone / "captures.json")], clone)
    content = json.loads((clone / "captures.json").read_text())
    left = [row for row in content["rows"] if row["variant"] != "beags-fast"]
    for change, words in (({"quick": True}, "figures mean nothing"), ({"rows": left}, "no figures of 'beags-fast'")):
        (clone / "captures.json").write_text(json.dumps({**content, **change}))
        with pytest.raises(UserError, match=words):
            page_tables.main([str(clone / "captures.json")], clone)
    (clone / "page.md").write_text("nothing")
    with pytest.raises(UserError, match="lacks the lines"):
        page_tables.main([], clone)
