"""What the comparison of sources by the same clicks asks of each, and how it scores their masks."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from benchmarks import prompted_masks
from benchmarks.prompted_masks import IGNORED, main, overlap, prompts_of, refined


def views() -> dict[str, np.ndarray]:
    """Two views of a large and a small thing; each is largest in another one."""
    first, second = np.zeros((30, 40), np.int32), np.zeros((30, 40), np.int32)
    first[5:25, 4:20], first[10:14, 30:34] = 1, 2
    second[8:20, 6:14], second[8:20, 24:36] = 1, 2
    return {"a": first, "b": second}


def test_the_cut_gets_points_in_one_view_and_grabcut_boxes_in_all_prompted_ones():
    names = {0: "background", 1: "large", 2: "small"}
    asked, prompted = prompts_of(views(), names, boxes=False)
    assert prompted == {"a", "b"}
    for entry, view in zip(asked["objects"], ("a", "b"), strict=True):
        (prompt,) = entry["prompts"]
        ids = views()[view]
        assert prompt["view"] == view and "box" not in prompt
        assert [ids[row, column] for column, row in prompt["points"]] == [entry["id"]] * 3
        assert all(ids[row, column] != entry["id"] for column, row in prompt["outside"]) and len(prompt["outside"]) == 2
    boxed, _ = prompts_of(views(), names, boxes=True)
    assert [each["box"] for each in boxed["objects"][0]["prompts"]] == [[4, 5, 20, 25], [6, 8, 14, 20]]
    assert ["points" in each for each in boxed["objects"][1]["prompts"]] == [False, True]


def test_masks_are_scored_in_views_without_a_prompt_and_where_the_truth_is_known(tmp_path):
    truth = {"a": np.zeros((2, 4), np.int32), "b": np.array([[1, 1, 2, 0], [1, 1, IGNORED, 0]], np.int32)}
    (tmp_path / "masks").mkdir()
    drawn = np.array([[1, 1, 2, 2], [1, 0, 2, 0]], np.uint8)
    Image.fromarray(drawn).save(tmp_path / "masks/b.png")
    Image.fromarray(1 - drawn).save(tmp_path / "masks/a.png")  # prompted: does not count
    assert overlap(tmp_path, truth, [1, 2], {"a"}, as_one=False) == pytest.approx(100 * (3 / 4 + 1 / 2) / 2)
    assert overlap(tmp_path, truth, [1, 2], {"a"}, as_one=True) == pytest.approx(100 * 4 / 6)


def test_the_command_line_chooses_preset_and_sources(monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(prompted_masks, "compare", lambda *given: asked.append(given))
    options = ["--refine", "--preset", "beags-refine", "--sources", "cut", "--snap", "2"]
    main([*options, "out", "a/config.yml", "b/config.yml"])
    assert [(str(run), str(output), *others) for run, output, *others in asked] == [
        ("a/config.yml", "out", ["cut"], "beags-refine", 2),
        ("b/config.yml", "out", ["cut"], "beags-refine", 2),
    ]
    asked.clear()
    main(["out", "a/config.yml"])
    assert asked[0][2:] == (["cut", "grabcut", "salient"], None, 0)
    main(["--refine", "out", "a/config.yml"])
    assert asked[1][3] == "beags-fast"
    for wrong in (["--sources", "cut,sam9"], ["--preset", "beags-slow"]):
        with pytest.raises(SystemExit):
            main([*wrong, "out", "a/config.yml"])
        assert wrong[1].split(",")[-1] in capsys.readouterr().err


def test_runs_of_different_presets_are_kept_apart_and_not_trained_again(monkeypatch, tmp_path):
    trained = []

    def train(config):
        trained.append((config.method_name, config.run_dir, config.pipeline.model.base_steps))
        config.run_dir.mkdir(parents=True)
        (config.run_dir / "config.yml").touch()

    def score(path: Path):
        biou = {"beags-fast": 0.5, "beags-refine": 0.75}[path.parent.name]
        extracted = {"extracted": {"after": {"biou": biou}}}
        return SimpleNamespace(to_json=lambda: {"mean": extracted, "worst": "cup", "objects": {"cup": extracted}})

    monkeypatch.setattr("beags_plugin.plugin.launch.train", train)
    monkeypatch.setattr("beags_plugin.objects.evaluate.evaluate_run", score)
    for _ in range(2):
        for preset, text in (("beags-fast", "50.0, 50.0"), ("beags-refine", "75.0, 75.0")):
            assert refined(tmp_path, tmp_path, tmp_path, tmp_path / "cut", preset) == text
    assert trained == [(name, tmp_path / "cut" / name, 0) for name in ("beags-fast", "beags-refine")]
