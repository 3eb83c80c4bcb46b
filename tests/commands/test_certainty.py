"""What beags demo says at its end about how sure it is, and where --strict stops it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from data_folders import write_image
from run_folders import write_scene

from beags_plugin.commands import demo, demo_training
from beags_plugin.commands.certainty import certainty, write_doubt
from beags_plugin.commands.made_masks import MADE, as_made
from beags_plugin.commands.scene_setup import MadeScene
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.classes import write_mask
from beags_plugin.masks.check.contradictions import Contradiction
from beags_plugin.objects import check_masks
from beags_plugin.system.digests import folder_digest
from beags_plugin.system.errors import UserError
from beags_plugin.views.close_ups import CLOSE_UPS


def write_run(folder: Path, agreement: float | None, overruled: list[str]) -> Path:
    """Write what certainty reads of a run: its report, and masks of an object of 40 x 20 pixels."""
    (folder / "prepared/masks").mkdir(parents=True)
    report = {"agreement": agreement, "masks": 20, "overruled": overruled, "doubtful": 0.004, "views": []}
    (folder / "prepared/report.json").write_text(json.dumps({} if agreement is None else {"agreement": report}))
    mask = np.zeros((60, 80), np.uint16)
    mask[10:30, 5:45] = 1
    mask[50:] = IGNORE
    write_mask(folder / "prepared/masks/a.png", mask)
    return folder


@pytest.mark.parametrize(
    ("agreement", "overruled", "level"),
    [(0.97, [], "sure"), (0.97, ["a"], "fairly sure"), (0.8, [], "fairly sure"), (0.7, [], "not sure"),
     (0.95, ["a", "b", "c"], "not sure"), (None, [], "not judged")],
)  # fmt: skip
def test_the_words_follow_from_what_the_masks_agree_on(tmp_path, agreement, overruled, level):
    found = certainty(write_run(tmp_path / "run", agreement, overruled), tmp_path)
    assert found.level == level
    said = " ".join(found.lines)
    assert (f"How sure: {level}" in said) == (agreement is not None)
    assert ("beags demo --pick --fresh" in said) == (level in ("fairly sure", "not sure"))
    assert "40 x 20 pixels" in said and "--downscale 1" in said
    assert found.figures["object pixels"] == [40, 20]


def test_the_size_is_that_in_close_ups_where_training_saw_some(tmp_path):
    run = write_run(tmp_path / "run", None, [])
    (run / "prepared/report.json").write_text(json.dumps({"magnified": 4.5}))
    (run / "prepared/masks" / CLOSE_UPS).mkdir()
    shutil.copy(run / "prepared/masks/a.png", run / "prepared/masks" / CLOSE_UPS / "a-1.png")
    found = certainty(run, tmp_path)
    assert found.figures["object pixels"] == [180, 90] and "--downscale" not in " ".join(found.lines)


def test_the_size_is_that_of_one_object_where_there_are_several(tmp_path):
    run = write_run(tmp_path / "run", None, [])
    mask = np.zeros((60, 80), np.uint16)
    mask[:20, :10], mask[40:, 50:60] = 1, 2
    write_mask(run / "prepared/masks/a.png", mask)
    assert "Objects have about 10 x 20 pixels" in " ".join(certainty(run, tmp_path).lines)


def test_photos_without_poses_and_masks_to_delete_are_named(tmp_path):
    (tmp_path / "poses.json").write_text(json.dumps({"photos": 30, "registered": 26}))
    overruled = [f"v {index}" for index in range(8)]
    lines = certainty(write_run(tmp_path / "run", 0.6, overruled), tmp_path, tmp_path / "masks").lines
    assert "4 of 30 photos have no pose and were left out." in lines
    assert "8 of 20 masks were overruled" in " ".join(lines)
    (command,) = [line for line in lines if line.startswith("    rm ")]
    assert command.count(".png'") == 6 and f"'{tmp_path}/masks/v 0.png'" in command
    assert any("(2 more)" in line for line in lines)


@pytest.mark.parametrize(("found", "said"), [(3, False), (2, True)])
def test_things_told_apart_are_judged_by_their_own_report_and_fewer_are_said(tmp_path, found, said):
    run, apart = write_run(tmp_path / "run", None, []), tmp_path / "apart"
    apart.mkdir()
    agreement = {"agreement": 0.97, "masks": 20, "overruled": [], "doubtful": 0.004, "views": []}
    (apart / "report.json").write_text(json.dumps({**agreement, "things": {"asked": 3, "found": found, "more": 0}}))
    (apart / "doubt.png").write_bytes(b"drawn")
    judged = certainty(run, tmp_path, None, "beags demo --data x --pick", apart)
    assert judged.level == "sure" and judged.figures["things"]["found"] == found
    sentence = "Only 2 separate things were found, not 3: click on things that touch, or that most masks lack."
    assert (sentence in judged.lines) is said and ("    beags demo --data x --pick --fresh" in judged.lines) is said
    assert write_doubt(run, tmp_path / "doubt.png", apart) and (tmp_path / "doubt.png").read_bytes() == b"drawn"


def test_masks_that_a_network_made_are_made_to_agree_and_those_that_were_mended_are_not(tmp_path, monkeypatch):
    data, words = write_scene(tmp_path / "data"), []
    monkeypatch.setattr(demo_training, "finish", words.extend)
    scene = MadeScene(data)

    def agrees(photos: str = "all") -> bool:
        words.clear()
        demo_training.train(scene, tmp_path / "run", "beags-tiny", 1.0, photos)
        return "--pipeline.model.prepare.agree" in words

    assert not agrees()  # the user's own
    (data / MADE).write_text(json.dumps({"photos": "", "masks": folder_digest(data / "masks")}))
    assert as_made(data) and agrees() and not agrees("objects")
    write_image(data / "masks/v03.png", np.zeros((12, 16), np.uint8))
    assert not agrees()


def test_strict_stops_before_training_where_masks_contradict(tmp_path, monkeypatch):
    data = write_scene(tmp_path / "data")
    contradiction = Contradiction("v03", 1, 5, 0, 10, "points")
    report = SimpleNamespace(contradictions=[contradiction])
    monkeypatch.setattr(check_masks, "check_scene", lambda _: report)
    monkeypatch.setattr(check_masks, "write_contradictions", lambda _, output: [output / "contradicted.png"])
    with pytest.raises(UserError, match=r"1 masks contradict the others \(v03; see .*contradicted.png\)"):
        demo.run_demo(data, tmp_path / "out", "beags-tiny", None, 0, False, True)
    assert not (tmp_path / "out/run").exists()
    monkeypatch.setattr(demo, "train_once", lambda *_, **__: None)
    monkeypatch.setattr(demo, "measure", lambda *_, **__: None)
    demo.run_demo(data, tmp_path / "out", "beags-tiny", None, 0, False)
    report.contradictions.clear()
    demo.run_demo(data, tmp_path / "out", "beags-tiny", None, 0, False, True)
