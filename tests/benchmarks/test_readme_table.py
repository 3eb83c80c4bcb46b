"""README's table of results: every figure is one of the committed files'."""

from __future__ import annotations

import json
import shutil

import pytest
from places import ROOT

pytest.importorskip("nerfstudio")

from experiment_files import GOOD, written

from beags_plugin.bench.experiment import Variant, load_experiment
from beags_plugin.bench.results import FIGURES, ResultRow, report_json
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.system.errors import UserError
from benchmarks import readme_table

RESULTS = ROOT / "docs" / "results"
COSTS = {"rendered_iou_after": 0.75, "removal_ssim_after": 0.875, "steps": 200, "cpu_seconds": 40.5,
         "cpu_seconds total": 90.25, "own_memory_mb": 300.5, "peak_memory_mb": 900.5}  # fmt: skip


def cells(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]


def test_readme_has_the_figures_of_the_committed_files():
    """Looked up here by their own names, so that neither README nor the program can go wrong alone."""
    text = (ROOT / "README.md").read_text()
    shown = text.partition(readme_table.BEGIN)[2].partition(readme_table.END)[0]
    assert shown.strip() == readme_table.table(RESULTS).strip()
    rows = json.loads((RESULTS / "captures.json").read_text())["rows"]
    places = [(scene, variant) for scene in ("bear, salient", "kitchen, salient")
              for variant in readme_table.CAPTURED]  # fmt: skip
    assert len(cells(shown)) == 2 + len(places)
    for (scene, variant), row in zip(places, cells(shown)[2:], strict=True):
        (own,) = (row for row in rows if row["variant"] == variant and row["scene"] == scene)
        assert row[1].strip("`") == variant
        assert row[2] == f"{100 * own['extracted_iou_after']:.1f}, {100 * own['extracted_biou_after']:.1f}"
        assert row[3] == f"{100 * own['extracted_spill_after']:.1f}" and row[4] == f"{own['psnr_fit_after']:.2f}"
    for name in {name for _, name, *_ in readme_table.GROUPS}:
        source = json.loads((RESULTS / f"{name}.json").read_text())
        assert source["command"] and source["commit"] and source["machine"]["cpu"] and not source["quick"]


def objects_of(place: int, figures: dict) -> dict[str, dict]:
    """Return figures of two objects; of the second, masks are empty in truth and as rendered."""
    return {
        "cup": {**figures, "extracted_biou_after": 0.8 + 0.0123456 * place},
        "box": {**figures, "extracted_biou_after": None},
    }


@pytest.fixture
def clone(tmp_path):
    """A folder with README and results, and a fresh result of captures, with objects and a failure."""
    shutil.copytree(RESULTS, tmp_path / "docs/results", ignore=shutil.ignore_patterns("*.png"))
    shutil.copy(ROOT / "README.md", tmp_path)
    experiment = load_experiment(written(tmp_path, GOOD))
    figures = {**dict.fromkeys(FIGURES), "extracted_iou_after": 0.91234567, "extracted_biou_after": 0.8,
               "worst_biou_after": 0.5, "psnr_fit_after": 30.126, "extracted_spill_after": 0.025, **COSTS}  # fmt: skip
    rows = [
        ResultRow(Variant(name), scene, 1, figures, objects_of(place, figures), protocol=Protocol(), truth="visible")
        for place, scene in enumerate(("bear, salient", "kitchen, salient", "fruit, given"))
        for name in readme_table.CAPTURED[:3]
    ]
    for scene in ("bear, salient", "kitchen, salient", "fruit, given"):
        rows.append(ResultRow(Variant("beags-refine"), scene, 1, dict.fromkeys(FIGURES), {}, "no memory"))
    command = "beags bench captures --data-root /data/scenes --output /tmp/bench --scenes bear"
    source = {"command": command, "commit": "abc", "machine": {"cpu": "x"}, "torch": "2", "quick": False}
    (tmp_path / "captures.json").write_text(json.dumps(report_json(experiment, rows, source)))
    return tmp_path


def test_one_command_makes_the_table_from_a_result(clone):
    readme_table.main([str(clone / "captures.json")], clone)
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
    assert readme_table.reduced(kept) == kept
    assert kept["means"][0]["extracted_iou_after"] == 0.912346
    assert COSTS.items() <= kept["rows"][0].items() and COSTS.items() <= kept["means"][0].items()
    assert not COSTS.keys() & kept["rows"][9].keys()  # failed
    text = (clone / "README.md").read_text()
    head, line, alone, paper, fast, failed, *_ = cells(text.partition(readme_table.BEGIN)[2])
    assert head[2:4] == ["extracted IoU, BIoU, %", "spill, %"]
    assert alone[1:] == ["assignment alone", "91.2, 80.0", "2.5", "30.13", "40"]
    assert paper[1:] == ["the paper's losses", *alone[2:]] and fast[1:] == ["`beags-fast`", *alone[2:]]
    assert failed[1:] == ["`beags-refine`", "–, –", "–", "–", "–"] and line[0] == "---"
    readme_table.main([], clone)
    assert (clone / "README.md").read_text() == text and text.startswith("# beags")
    assert text.endswith((ROOT / "README.md").read_text().partition(readme_table.END)[2])


def test_a_family_of_scenes_is_averaged_and_keeps_its_worst_object(tmp_path):
    shown = (("room 100", 30.0, 0.5), ("room 101", 32.0, 0.7), ("rooms", 9.0, 0.1))
    rows = [{"scene": scene, "variant": "beags", "psnr_after": psnr, readme_table.WORST: worst}
            for scene, psnr, worst in shown]  # fmt: skip
    rows.append({**rows[0], "scene": "room 102", "psnr_after": None, "failed": "no memory", readme_table.WORST: None})
    (tmp_path / "presets.json").write_text(json.dumps({"rows": rows}))
    (mean,) = readme_table._rows(tmp_path / "presets.json", "room", ())
    assert mean == {"variant": "beags", "psnr_after": 31.0, readme_table.WORST: 0.5}


def test_what_cannot_be_a_table_is_refused(clone):
    captures = clone / "docs/results/captures.json"
    content = json.loads(captures.read_text())
    left = [row for row in content["rows"] if row["variant"] != "beags-fast"]
    for change, words in (({"quick": True}, "figures mean nothing"), ({"rows": left}, "no figures of 'beags-fast'")):
        (clone / captures.name).write_text(json.dumps({"means": [], **content, **change}))
        with pytest.raises(UserError, match=words):
            readme_table.main([str(clone / captures.name)], clone)
    (clone / "README.md").write_text("nothing")
    with pytest.raises(UserError, match="lacks the lines"):
        readme_table.main([], clone)
