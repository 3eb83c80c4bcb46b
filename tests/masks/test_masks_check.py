"""The check of masks finds each planted mistake, and nothing in good masks."""

from __future__ import annotations

import json
import shlex
import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from ball_scenes import SIDE, balls_from, issues, poses, write_balls
from data_folders import write_image, write_transforms

from beags_plugin.commands.cli import main
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.classes import write_mask
from beags_plugin.masks.check.consistency import UNSEEN, Agreement, labels_around, labels_at, ranks_of
from beags_plugin.masks.check.disagreement import views_against_others
from beags_plugin.masks.check.files import Coverage, MaskFiles
from beags_plugin.masks.check.issues import named, percent
from beags_plugin.pictures.masks import coverage_picture


def exchanged(ids: np.ndarray, *order: int) -> np.ndarray:
    return np.array([0, *order], np.uint8)[ids]


def test_good_masks_give_no_finding(tmp_path):
    assert issues(write_balls(tmp_path)) == {}


def test_a_scene_without_masks_is_told_the_whole_command_that_makes_them(tmp_path):
    root = write_balls(tmp_path / "my scene")
    shutil.rmtree(root / "masks")
    (missing,) = issues(root)["missing"]
    words = shlex.split(missing.message.partition("make them with: ")[2])
    assert words == ["beags", "masks", "make", "--data", str(root), "--source", "salient"]


def test_exchanged_ids_are_found_with_the_view(tmp_path):
    plan = {3: (2, 1, 3), 9: (3, 1, 2)}
    found = issues(write_balls(tmp_path, lambda view, ids: exchanged(ids, *plan.get(view, (1, 2, 3)))))
    assert {issue.views for issue in found["swapped ids"]} == {("v03",), ("v09",)}
    pair = next(issue for issue in found["swapped ids"] if issue.views == ("v03",))
    assert "2 (right) instead of 1 (left), 1 (left) instead of 2 (right)" in pair.message
    assert f"1 mask ({tmp_path / 'masks/v03.png'})" in pair.message
    pixels = int(np.isin(balls_from(poses()[3]), (1, 2)).sum())
    assert f"{pixels} pixels" in pair.cost
    assert set(found) == {"swapped ids"}


def test_an_inverted_mask_is_found(tmp_path):
    def change(view, ids):
        one = (ids == 1).astype(np.uint8)
        return 1 - one if view == 5 else one

    root = write_balls(tmp_path, change)
    (root / "classes.json").write_text('{"1": "left"}')
    found = issues(root)
    assert found["inverted"][0].views == ("v05",) and set(found) == {"inverted"}
    assert str(root / "masks/v05.png") in found["inverted"][0].message


def test_an_id_used_in_a_single_view_is_an_exchange(tmp_path):
    root = write_balls(tmp_path, lambda view, ids: exchanged(ids, 1, 2, 9 if view == 4 else 3))
    (root / "classes.json").write_text('{"1": "left", "2": "right", "3": "top", "9": "odd"}')
    found = issues(root)
    assert found["swapped ids"][0].views == ("v04",) and "9 (odd) instead of 3 (top)" in found["swapped ids"][0].message
    assert "id 9 (odd) is in 1 of" in found["few views"][0].message
    assert str(root / "masks/v04.png") in found["few views"][0].message


SQUARE = np.zeros((SIDE, SIDE), np.uint8)
SQUARE[5:43, 5:43] = 1  # more than half of a view


@pytest.mark.parametrize(
    ("change", "words", "lacking"),
    [
        (lambda view, ids: SQUARE * (view == 5), "v05.png is the only view that shows 1 (left), but 9 more views", 9),
        (
            lambda view, ids: SQUARE if view == 5 else SQUARE * (ids == view % 3 + 1) * (np.arange(SIDE) % 9 == view),
            "v05.png is the only view that shows 1 (left), but 9 more views", 9,
        ),
        (
            lambda view, ids: (ids == 1) * np.uint8(view in (2, 5, 9)),
            "v02.png, v05.png, v09.png are the only views that show 1 (left), but 7 more views of 10 should", 7,
        ),
    ],
)  # fmt: skip
def test_an_object_that_most_views_lack_is_no_mistake_of_the_others(tmp_path, change, words, lacking):
    root = write_balls(tmp_path, change)
    (root / "classes.json").write_text('{"1": "left"}')
    found = issues(root)
    (issue,) = found["absent"]
    assert words in issue.message and len(issue.views) == lacking and "v05" not in issue.views
    assert set(found) <= {"absent", "few views"}


@pytest.mark.parametrize("trained", [True, False])
def test_a_view_that_alone_shows_an_object_at_a_place_is_not_to_be_inverted(trained):
    """The masks of two views, trained or held out, show the object at two places where all others see background."""
    labels = np.zeros((40, 12), np.int16)
    labels[:, (3, 5)] = UNSEEN
    labels[:20, 3] = labels[20:, 5] = 1
    pixels = np.array([[1000, 30 * (view in (3, 5))] for view in range(12)])
    coverage = Coverage([0, 1], pixels, np.zeros(12, np.int64), pixels.sum(1), np.ones(12, bool))
    names = [f"v{view:02d}" for view in range(12)]
    masks, used = [Path(f"masks/{name}.png") for name in names], [trained or view not in (3, 5) for view in range(12)]
    files = MaskFiles(names, [(1, 1)] * 12, masks, Path("masks"), (), used, None, Path())
    (issue,) = views_against_others(Agreement(labels, 2), files, coverage, {0: "background", 1: "bear"})
    assert issue.kind == "only view" and "invert" not in issue.message
    assert "masks/v03.png, v05.png are the only views that show 1 (bear) there" in issue.message


def test_mistakes_in_files_name_file_and_remedy(tmp_path):
    def change(view, ids):
        if view == 2:
            return ids[::2]
        if view == 3:
            return np.repeat(ids[..., None], 3, axis=2)
        return None if view == 4 else exchanged(ids, 1, 2, 255) if view == 5 else exchanged(ids, 1, 2, 0)

    root = write_balls(tmp_path, change)
    write_image(root / "masks/other.png", np.zeros((4, 4), np.uint8))
    found = issues(root)
    assert str(root / "masks/v02.png") in found["size"][0].message and "48x24" in found["size"][0].message
    assert str(root / "masks/v03.png") in found["type"][0].message and "has colours" in found["type"][0].message
    unknown = found["unknown id"][0].message
    assert "id 255 is in 1 mask," in unknown and "--ignore-ids 255" in unknown
    assert found["missing"][0].views == ("v04",) and "1 of 10" in found["missing"][0].message
    assert "other.png" in found["unused"][0].message and "3 (top)" in found["unused name"][0].message
    levels = {kind: found[kind][0].level for kind in ("size", "type", "unknown id", "missing", "unused", "unused name")}
    assert list(levels.values()) == ["error"] * 3 + ["warning"] * 3
    assert "unknown id" not in issues(root, ignore_ids=(255,))


@pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        (lambda view, ids: ids[::2] if view == 2 else ids, "size", "2 (right): in 9 of 9 training views"),
        (lambda view, ids: 0 * ids if view % 8 else ids, "no object", "no mask of a training view in"),
    ],
)  # fmt: skip
def test_the_command_writes_its_report_and_ends_with_1_on_errors(tmp_path, capsys, monkeypatch, change, kind, words):
    root = write_balls(tmp_path / "scene", change)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["masks", "check", "--data", str(root)])
    assert ended.value.code == 1
    report = json.loads((tmp_path / "outputs/masks_check/scene/report.json").read_text())
    assert report["issues"][0]["kind"] == kind and report["issues"][0]["level"] == "error"
    assert report["coverage"][0]["pixels"]["1"] == int((balls_from(poses()[0]) == 1).sum())
    assert (tmp_path / "outputs/masks_check/scene/coverage.png").stat().st_size > 5000
    out = capsys.readouterr().out
    assert words in out and "3 objects; 1 error, " in out


@pytest.mark.filterwarnings("error:Attempting to set identical")
def test_no_picture_is_made_of_masks_without_objects(tmp_path):
    root = write_balls(tmp_path / "scene", lambda view, ids: np.zeros_like(ids))
    with suppress(SystemExit):
        main(["masks", "check", "--data", str(root), "--output", str(tmp_path / "out")])
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["report.json"]


def test_unlabelled_masks_are_named(tmp_path):
    def change(view, ids):
        return np.full_like(ids, 255) if view in (2, 7, 10) else ids

    root = write_balls(tmp_path, change)
    (note,) = issues(root, ignore_ids=(255,))["unlabelled"]
    assert note.message.startswith("25 %")
    assert f"most in {root / 'masks/v02.png'}, v07.png, v10.png: fine" in note.message


def test_an_image_that_is_no_id_image_is_reported_and_not_compared(tmp_path):
    root = write_balls(tmp_path)
    (root / "classes.json").unlink()
    write_mask(root / "masks/v02.png", np.arange(SIDE * SIDE, dtype=np.uint16).reshape(SIDE, SIDE))
    found = issues(root)
    assert set(found) == {"no id image"} and found["no id image"][0].level == "error"
    assert str(root / "masks/v02.png") in found["no id image"][0].message and found["no id image"][0].views == ("v02",)


def test_no_mask_at_all_is_an_error(tmp_path):
    write_transforms(tmp_path)
    found = issues(tmp_path)
    assert found["missing"][0].level == "error" and "beags masks make" in found["missing"][0].message


def test_labels_of_points_heed_the_image_and_its_outlines():
    ranks = np.array([[0, 1], [2, UNSEEN]], np.int16)
    xy = np.array([[0.5, 0.5], [1.5, 0.5], [0.5, 1.5], [1.5, 1.5], [-0.1, 0.5], [0.5, 0.5], [np.nan, 0.5]])
    z = np.array([1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0])
    assert labels_at(xy, z, ranks).tolist() == [0, 1, 2, UNSEEN, UNSEEN, UNSEEN, UNSEEN]
    halves = np.repeat(np.int16([0, 1]), 500)[None].repeat(700, axis=0)  # a band of 4 pixels
    columns = np.array([2, 300, 494, 497, 503, 506, 998])
    found = labels_around(np.stack([columns + 0.5, np.full(7, 350.5)], axis=1), halves)
    assert found.tolist() == [UNSEEN, 0, 0, UNSEEN, UNSEEN, 1, UNSEEN]


def test_confusion_leaves_the_view_itself_out():
    labels = np.array([[1, 1, 1, 0], [1, 1, 1, 1], [0, 0, 1, 1]], np.int16)
    agreement = Agreement(labels, 2)
    # point 0: in view 3 the others say 1; point 2: others of view 0 say 0, 1, 1: 1 wins with 2 of 3
    assert agreement.confusion[3].tolist() == [[0, 1], [1, 1]]
    assert agreement.confusion[0].tolist() == [[0, 0], [1, 2]]


def test_ranks_of_ids():
    found = ranks_of(np.array([[0, 7], [9, IGNORE]], np.uint16), [0, 7], IGNORE)
    assert found.tolist() == [[0, 1], [UNSEEN, UNSEEN]]


def test_words():
    assert named(range(7), 3) == "0, 1, 2 and 4 more" and named(["a", "b"]) == "a, b"
    assert percent(1, 3) == "33 %" and percent(1, 300) == "0.33 %" and percent(1, 0) == "0 %"


def test_coverage_picture_without_any_object(tmp_path):
    coverage_picture(tmp_path / "c.png", ["a"], [0, 1], {0: "b", 1: "c"}, np.zeros((1, 2)), np.array([False]))
    assert (tmp_path / "c.png").exists()
