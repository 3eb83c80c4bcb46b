"""What beags demo says at its end about how sure it is, and where --strict stops it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from ball_scenes import write_balls
from data_folders import write_image
from run_folders import write_scene

from beags_plugin.commands import demo, demo_training
from beags_plugin.commands.certainty import Certainty, certainty, write_doubt
from beags_plugin.commands.demo_again import Again
from beags_plugin.commands.made_masks import MADE, as_made
from beags_plugin.commands.photo_coverage import Coverage
from beags_plugin.commands.scene_setup import MadeScene
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.classes import write_mask
from beags_plugin.masks.check.contradictions import Contradiction
from beags_plugin.masks.check.issues import Issue
from beags_plugin.objects import check_masks
from beags_plugin.system.digests import content_digest
from beags_plugin.system.errors import UserError
from beags_plugin.views.close_ups import CLOSE_UPS


def write_run(folder: Path, agreement: float | None, overruled: list[str], far: int = 0, **more: object) -> Path:
    """Write what certainty reads of a run: its report, and masks of an object of 40 x 20 pixels.

    far: number of the 20 views that contradict the others by 30 %.
    """
    (folder / "prepared/masks").mkdir(parents=True)
    views = [{"view": f"v{view}", "contradicts": 0.3 if view < far else 0.05} for view in range(20)]
    views.append({"view": "none", "contradicts": None})
    report = {"agreement": agreement, "masks": 20, "overruled": overruled, "doubtful": 0.004, "views": views, **more}
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
    found = certainty(write_run(tmp_path / "run", agreement, overruled), MadeScene(tmp_path), Again())
    assert found.level == level
    said = " ".join(found.lines)
    assert (f"How sure: {level}" in said) == (agreement is not None)
    assert ("    beags demo --pick --fresh" in found.lines) == (agreement is not None), (
        "a network may mark another thing"
    )
    assert "40 x 20 pixels" in said and "    beags demo --downscale 1 --fresh" in found.lines
    assert found.figures["object pixels"] == [40, 20]


def test_too_few_masks_are_not_judged(tmp_path):
    run = write_run(tmp_path / "run", 1.0, [], masks=2)
    found = certainty(run, MadeScene(tmp_path), Again())
    assert found.level == "not judged" and found.lines[0] == "How sure: not judged, as only 2 masks show an object."


def test_masks_that_were_overruled_or_misplaced_are_not_counted_again(tmp_path):
    run = write_run(tmp_path / "run", 0.95, ["v0"], far=6, misplaced=["v1", "v2"])
    line = certainty(run, MadeScene(tmp_path), Again()).lines[0]
    assert "1 of 20 masks was overruled as a whole; 3 more contradict the others on over 20 %" in line


def test_commands_to_go_on_keep_the_options_of_the_demo():
    again = Again(Path("my photos"), Path("out"), "beags", 2.0, 3, False, "rembg", ("model=birefnet",), 0)
    base = "beags demo --data 'my photos' --output out --preset beags --downscale"
    assert str(again) == f"{base} 2.0 --objects 3 --mask-source rembg --mask-options model=birefnet"
    assert again.picking() == f"{base} 2.0 --objects 3 --pick", "--pick makes no masks"
    assert again.larger() == f"{base} 1 --objects 3 --mask-source rembg --mask-options model=birefnet"
    assert Again(downscale=1.0).larger() is None and str(Again(seed=5)) == "beags demo --seed 5"
    picked = Again(Path("x"), pick=True)
    assert picked.larger() == "beags demo --data x --downscale 1 --pick", "the picks stay"


@pytest.mark.parametrize(("far", "level"), [(1, "sure"), (2, "fairly sure"), (8, "fairly sure")])
def test_a_group_of_views_that_contradicts_the_others_is_said_although_most_agree(tmp_path, far, level):
    found = certainty(write_run(tmp_path / "run", 0.93, [], far), MadeScene(tmp_path), Again())
    assert found.level == level
    assert (f"{far} contradict the others on over 20 %" in found.lines[0]) == (level != "sure")


@pytest.mark.parametrize(
    ("names", "said"),
    [(["a"], "1 photo seems to have a wrong pose (a): its mask fits the object"),
     (["a", "b"], "2 photos seem to have a wrong pose (a, b): their masks fit")],
)  # fmt: skip
def test_photos_with_wrong_poses_are_named(tmp_path, names, said):
    lines = certainty(write_run(tmp_path / "run", 0.95, [], misplaced=names), MadeScene(tmp_path), Again()).lines
    assert said in lines[-1]


def test_photos_that_were_left_out_are_named(tmp_path):
    scene = MadeScene(tmp_path, without=("a", "b"))
    found = certainty(write_run(tmp_path / "run", 0.95, []), scene, Again())
    assert "2 photos seemed to have a wrong pose and were left out (a, b)." in found.lines
    assert found.figures["left out"] == ["a", "b"]


def test_what_photos_do_not_show_is_said_and_stored(tmp_path):
    seen = Coverage(5, ["v1", "v2"], {"cup": 120, "plate": 30})
    found = certainty(write_run(tmp_path / "run", None, []), MadeScene(tmp_path), Again(), seen=seen)
    said = " ".join(found.lines)
    assert "In 2 of 5 photos kept out of training (v1, v2), something hides the object" in said
    assert "About 120 of the 360 degrees around cup are in no photo" in said and "plate" not in said
    assert found.figures["veiled"] == ["v1", "v2"] and found.figures["degrees without photos"]["plate"] == 30
    assert Coverage(5, [], {"cup": 0}).lines() == []


def test_the_size_is_that_in_close_ups_where_training_saw_some(tmp_path):
    run = write_run(tmp_path / "run", None, [])
    (run / "prepared/report.json").write_text(json.dumps({"magnified": 4.5}))
    (run / "prepared/masks" / CLOSE_UPS).mkdir()
    shutil.copy(run / "prepared/masks/a.png", run / "prepared/masks" / CLOSE_UPS / "a-1.png")
    found = certainty(run, MadeScene(tmp_path), Again())
    assert found.figures["object pixels"] == [180, 90] and "--downscale" not in " ".join(found.lines)


def test_the_size_is_that_of_one_object_where_there_are_several(tmp_path):
    run = write_run(tmp_path / "run", None, [])
    mask = np.zeros((60, 80), np.uint16)
    mask[:20, :10], mask[40:, 50:60] = 1, 2
    write_mask(run / "prepared/masks/a.png", mask)
    assert "Objects have about 10 x 20 pixels" in " ".join(certainty(run, MadeScene(tmp_path), Again()).lines)


def test_photos_without_poses_are_named(tmp_path):
    poses = {"photos": 30, "registered": 26, "without_pose": ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]}
    (tmp_path / "poses.json").write_text(json.dumps(poses))
    run = write_run(tmp_path / "run", None, [])
    lines = certainty(run, MadeScene(tmp_path), Again()).lines
    assert "4 of 30 photos have no pose and were left out (a.jpg, b.jpg, c.jpg, d.jpg)." in lines
    poses |= {"registered": 29, "without_pose": ["a.jpg"]}
    (tmp_path / "poses.json").write_text(json.dumps(poses))
    assert "1 of 30 photos has no pose and was left out (a.jpg)." in certainty(run, MadeScene(tmp_path), Again()).lines


def write_made(data: Path) -> None:
    """Write that a network made the masks of a scene."""
    files = {path.name: content_digest([path]) for path in (data / "masks").glob("*.png")}
    (data / MADE).write_text(json.dumps({"photos": "", "masks": "of all", "files": files}))


def test_masks_to_delete_are_named_with_the_command_that_trains_again(tmp_path):
    data, overruled = write_scene(tmp_path / "data"), [f"v {index}" for index in range(14)]
    write_made(data)
    lines = certainty(write_run(tmp_path / "run", 0.6, overruled), MadeScene(data), Again(Path("x"))).lines
    assert "14 of 20 masks were overruled" in lines[0]
    (number,) = [number for number, line in enumerate(lines) if line.startswith("    rm ")]
    assert lines[number].count(".png'") == 12 and f"'{data}/masks/v 0.png'" in lines[number]
    assert "(2 more)" in lines[number - 1] and lines[number + 1] == "    beags demo --data x --fresh"


@pytest.mark.parametrize(("found", "said"), [(3, False), (2, True)])
def test_things_told_apart_are_judged_by_their_own_report_and_fewer_are_said(tmp_path, found, said):
    run, apart = write_run(tmp_path / "run", None, []), tmp_path / "apart"
    apart.mkdir()
    agreement = {"agreement": 0.97, "masks": 20, "overruled": [], "doubtful": 0.004, "views": []}
    (apart / "report.json").write_text(json.dumps({**agreement, "things": {"asked": 3, "found": found, "more": 0}}))
    (apart / "doubt.png").write_bytes(b"drawn")
    judged = certainty(run, MadeScene(tmp_path), Again(Path("x")), apart)
    assert judged.level == "sure" and judged.figures["things"]["found"] == found
    assert judged.lines[0].endswith("0.4 % of all pixels are in doubt.")
    sentence = "Only 2 separate things were found, not 3: click on things that touch, or that most masks lack."
    assert (sentence in judged.lines) is said and "    beags demo --data x --pick --fresh" in judged.lines
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
    write_made(data)
    assert as_made(data) and agrees() and not agrees("objects")
    (data / "masks/v02.png").unlink()
    assert agrees() and not scene.mended, "without a mask that the user deleted the others still have shared errors"
    write_image(data / "masks/v03.png", np.zeros((12, 16), np.uint8))
    assert not agrees() and scene.mended
    assert (
        "How sure: not judged, as the masks are no longer"
        in certainty(write_run(tmp_path / "r", None, []), scene, Again()).lines[0]
    )


@pytest.fixture
def stand(tmp_path, monkeypatch):
    """A demo with --strict on a scene whose check reports what the test says, and whose training ends in no time."""
    stand = SimpleNamespace(data=write_scene(tmp_path / "data"), output=tmp_path / "out", level="sure")
    stand.report = SimpleNamespace(contradictions=[], issues=[], tracked=True)
    monkeypatch.setattr(check_masks, "check_scene", lambda _: stand.report)
    monkeypatch.setattr(check_masks, "write_contradictions", lambda _, output: [output / "contradicted.png"])
    monkeypatch.setattr(demo, "train_once", lambda *_, **__: None)
    monkeypatch.setattr(demo, "measure", lambda *_, **__: Certainty(stand.level, []))
    stand.run = lambda strict=True: demo.run_demo(stand.data, stand.output, "beags-tiny", None, 0, False, strict)
    return stand


def test_strict_stops_before_training_where_masks_contradict(stand, capsys):
    stand.run()
    assert "Without points" not in capsys.readouterr().out
    stand.report.tracked = False
    stand.run()
    assert "Without points of COLMAP's, only inverted and exchanged masks are found" in capsys.readouterr().out
    stand.report.contradictions = [Contradiction("v03", 1, 5, 0, 10, "points")]
    with pytest.raises(UserError, match=r"1 mask contradicts the others \(v03; see .*contradicted.png\)"):
        stand.run()
    stand.run(strict=False)


@pytest.mark.parametrize("kind", ["inverted", "swapped ids"])
def test_strict_stops_at_whole_masks_that_contradict(stand, kind, monkeypatch):
    monkeypatch.setattr(check_masks, "write_contradictions", lambda *_: [])
    stand.report.issues = [
        Issue("warning", kind, "message", "cost", ("v01", "v02")),
        Issue("note", "few", "", "", ("v05",)),
    ]
    with pytest.raises(UserError, match=r"2 masks contradict the others \(v01, v02\): correct"):
        stand.run()


def test_strict_finds_inverted_masks_without_a_colmap_model(tmp_path, monkeypatch):
    data = write_balls(tmp_path / "data", lambda view, ids: np.uint8((ids == 1) != (view in (5, 6))))
    (data / "classes.json").write_text('{"1": "left"}')
    monkeypatch.setattr(demo, "train_once", lambda *_, **__: pytest.fail("it must not train"))
    with pytest.raises(UserError, match=r"2 masks contradict the others \(v05, v06"):
        demo.run_demo(data, tmp_path / "out", "beags-tiny", None, 0, False, True)


def test_strict_fails_at_the_end_where_the_result_is_not_sure(stand):
    stand.level = "not sure"
    with pytest.raises(UserError, match="the masks contradict each other too much"):
        stand.run()
    stand.run(strict=False)
