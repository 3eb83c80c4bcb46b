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
    places = (
        ("presets", "beags-fast", "tabletop"),
        ("presets-whole", "beags", "tabletop"),
        ("presets", "beags-fast", "room"),
        ("presets-whole", "beags", "room"),
        ("presets-captures", "beags-fast", "fruit"),
        ("presets-whole-captures", "beags", "fruit"),
        ("presets-captures", "beags-fast", "dtu_skull"),
        ("presets-whole-captures", "beags", "dtu_skull"),
    )
    of_presets = (row for row in cells(shown) if row[1] in ("`beags-fast`", "`beags`"))
    for (name, preset, scene), row in zip(places, of_presets, strict=True):
        rows = json.loads((RESULTS / f"{name}.json").read_text())["rows"]
        own = [row for row in rows if row["variant"] == preset and row["scene"].startswith(scene)]
        iou, biou, psnr = (
            sum(row[name] for row in own) / len(own)
            for name in ("extracted_iou_after", "extracted_biou_after", "psnr_after")
        )
        assert row[2] == f"{100 * iou:.1f}, {100 * biou:.1f}"
        assert row[1 + cells(shown)[0][1:].index("PSNR")] == f"{psnr:.2f}"
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
    """A folder with README and results, and a fresh result of the presets, with objects and a failure."""
    shutil.copytree(RESULTS, tmp_path / "docs/results", ignore=shutil.ignore_patterns("*.png"))
    shutil.copy(ROOT / "README.md", tmp_path)
    experiment = load_experiment(written(tmp_path, GOOD))
    figures = {**dict.fromkeys(FIGURES), "extracted_iou_after": 0.91234567, "extracted_biou_after": 0.8,
               "worst_biou_after": 0.5, "psnr_after": 30.126, "psnr_shown_after": 31.0, **COSTS}  # fmt: skip
    rows = [
        ResultRow(Variant(name), scene, 1, figures, objects_of(place, figures), protocol=Protocol(), truth="visible")
        for place, scene in enumerate(("tabletop 1", "tabletop 2", "room 1"))
        for name in readme_table.FAST[:2]
    ]
    for scene in ("tabletop 1", "room 1"):
        rows.append(ResultRow(Variant("beags-fast"), scene, 1, dict.fromkeys(FIGURES), {}, "no memory"))
    command = "beags bench presets --data /data/fruit tin --output /tmp/bench --scenes 1"
    source = {"command": command, "commit": "abc", "machine": {"cpu": "x"}, "torch": "2", "quick": False}
    (tmp_path / "presets.json").write_text(json.dumps(report_json(experiment, rows, source)))
    return tmp_path


def test_one_command_makes_the_table_from_a_result(clone):
    readme_table.main([str(clone / "presets.json")], clone)
    kept = json.loads((clone / "docs/results/presets.json").read_text())
    assert kept["command"] == "beags bench presets --data fruit tin --scenes 1"
    assert kept["commit"] == "abc" and kept["machine"] == {"cpu": "x"}
    assert kept["protocol"].startswith("Protocol: extracted masks against visible masks, less")
    scenes = ["tabletop 1"] * 2 + ["tabletop 2"] * 2 + ["room 1"] * 2 + ["tabletop 1", "room 1"]
    assert [row["scene"] for row in kept["rows"]] == scenes
    assert kept["rows"][6]["failed"] == "no memory" and "objects" not in kept["rows"][6]
    bious = [{"cup": biou, "box": None} for biou in (0.8, 0.8, 0.8123, 0.8123, 0.8247, 0.8247)]
    assert [row["objects"] for row in kept["rows"][:6]] == bious and "objects" not in kept["means"][0]
    assert readme_table.reduced(kept) == kept
    assert kept["means"][0]["extracted_iou_after"] == 0.912346
    assert COSTS.items() <= kept["rows"][0].items() and COSTS.items() <= kept["means"][0].items()
    assert not COSTS.keys() & kept["rows"][6].keys()  # failed
    text = (clone / "README.md").read_text()
    head, line, alone, control, failed, *_ = cells(text.partition(readme_table.BEGIN)[2])
    assert head[2:] == ["extracted IoU, BIoU", "worst object's BIoU", "PSNR", "PSNR shown", "removal PSNR, shown"]
    assert alone[1:] == ["assignment alone", "91.2, 80.0", "50.0", "30.13", "31.00", "–, –"]
    assert control[1:] == ["as long as beags-fast, neither loss", *alone[2:]]
    assert failed[1:] == ["`beags-fast`", "–, –", "–", "–", "–", "–, –"] and line[0] == "---"
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
    captures = clone / "docs/results/presets-captures.json"
    content = json.loads(captures.read_text())
    left = [row for row in content["rows"] if row["variant"] != "beags-fast"]
    for change, words in (({"quick": True}, "figures mean nothing"), ({"rows": left}, "no figures of 'beags-fast'")):
        (clone / captures.name).write_text(json.dumps({"means": [], **content, **change}))
        with pytest.raises(UserError, match=words):
            readme_table.main([str(clone / captures.name)], clone)
    (clone / "README.md").write_text("nothing")
    with pytest.raises(UserError, match="lacks the lines"):
        readme_table.main([], clone)
