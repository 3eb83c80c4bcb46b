"""The check of masks finds each planted mistake, and nothing in good masks."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from data_folders import look_at, write_image, write_transforms
from parsed_views import real
from PIL import Image

from beags_plugin.commands.cli import main
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.classes import read_id_mask, write_mask
from beags_plugin.masks.check.areas import contradicted
from beags_plugin.masks.check.consistency import UNSEEN, Agreement, labels_around, labels_at, ranks_of
from beags_plugin.masks.check.contradictions import contradictions, settle
from beags_plugin.masks.check.disagreement import views_against_others
from beags_plugin.masks.check.files import Coverage, MaskFiles
from beags_plugin.masks.check.issues import named, percent
from beags_plugin.pictures.masks import Changed, coverage_picture

VIEWS, SIDE = 12, 48
BALLS = {1: ((-0.6, 0.0, 0.0), 0.4), 2: ((0.6, 0.1, 0.0), 0.4), 3: ((0.0, 0.7, 0.3), 0.3)}
FOCAL = 60.0


def poses() -> list[np.ndarray]:
    angles = 2 * np.pi * np.arange(VIEWS) / VIEWS
    return [look_at((4 * np.cos(a), 4 * np.sin(a), 1.5)) for a in angles]


def balls_from(pose: np.ndarray) -> np.ndarray:
    """[SIDE, SIDE] uint8 ids of the nearest ball along each pixel's ray."""
    row, column = np.mgrid[:SIDE, :SIDE] + 0.5
    local = np.stack([(column - SIDE / 2) / FOCAL, -(row - SIDE / 2) / FOCAL, -np.ones((SIDE, SIDE))], axis=2)
    rays = local @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    nearest, ids = np.full((SIDE, SIDE), np.inf), np.zeros((SIDE, SIDE), np.uint8)
    for class_id, (center, radius) in BALLS.items():
        to = np.asarray(center) - pose[:3, 3]
        along = rays @ to
        root = along**2 - to @ to + radius**2
        hit = np.where(root > 0, along - np.sqrt(np.maximum(root, 0)), np.inf)
        ids[hit < nearest], nearest = class_id, np.minimum(hit, nearest)
    return ids


def write_balls(root: Path, change=lambda view, ids: ids) -> Path:
    """A scene of three balls; ``change`` gives the mask of each view, None for no mask."""
    write_transforms(root, poses=poses(), fl_x=FOCAL, fl_y=FOCAL, cx=SIDE / 2, cy=SIDE / 2, w=SIDE, h=SIDE)
    meta = json.loads((root / "transforms.json").read_text())
    (root / "transforms.json").write_text(json.dumps({**meta, "w": SIDE, "h": SIDE, "fl_x": FOCAL, "fl_y": FOCAL}))
    (root / "classes.json").write_text(json.dumps({"1": "left", "2": "right", "3": "top"}))
    for view, pose in enumerate(poses()):
        write_image(root / f"images/v{view:02d}.png", np.full((SIDE, SIDE, 3), 90, np.uint8))
        if (mask := change(view, balls_from(pose))) is not None:
            write_image(root / f"masks/v{view:02d}.png", mask)
    return root


def write_model(root: Path) -> None:
    """Write a COLMAP model of photos twice as large, in which views show points of the balls and of what is below."""
    generator = np.random.default_rng(0)
    around = generator.normal(size=(3, 400, 3))
    around /= np.linalg.norm(around, axis=2, keepdims=True)
    centers, radii = (np.array([ball[part] for ball in BALLS.values()]) for part in (0, 1))
    on_balls = (centers[:, None] + radii[:, None, None] * around).reshape(-1, 3)
    ground = np.append(generator.uniform(-1.5, 1.5, (1500, 2)), np.full((1500, 1), -0.6), axis=1)
    points, ids = np.concatenate([on_balls, ground]), np.repeat([1, 2, 3, 0], [400, 400, 400, 1500])
    outward = np.concatenate([around.reshape(-1, 3), np.tile([0.0, 0.0, 1.0], (1500, 1))])
    lines = []
    for view, pose in enumerate(poses()):
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        xy = SIDE / 2 + FOCAL * local[:, :2] / -local[:, 2:] * [1, -1]
        faces = ((pose[:3, 3] - points) * outward).sum(1) > 1.0
        inside = faces & (xy >= 0).all(1) & (xy < SIDE).all(1)
        shown = balls_from(pose)
        seen = [p for p in np.flatnonzero(inside) if shown[int(xy[p, 1]), int(xy[p, 0])] == ids[p]]
        lines.append(f"{view + 1} 1 0 0 0 0 0 0 1 photos/v{view:02d}.jpg\n")
        lines.append(" ".join(f"{2 * xy[p, 0]} {2 * xy[p, 1]} {p}" for p in seen) + " 1.0 1.0 -1\n")
    (root / "colmap/sparse/0").mkdir(parents=True)
    (root / "colmap/sparse/0/images.txt").write_text("".join(lines))
    (root / "colmap/sparse/0/cameras.txt").write_text(f"1 PINHOLE {2 * SIDE} {2 * SIDE} 1 1 1 1\n")


def damaged(view: int, ids: np.ndarray) -> np.ndarray:
    """Cut the lower half of ball 1 off in view 3, and add ground to ball 2 in view 7."""
    rows, columns = np.nonzero(ids == {3: 1, 7: 2}.get(view, 3))
    if view == 3:
        ids[rows[rows >= np.median(rows)], columns[rows >= np.median(rows)]] = 0
    if view == 7:
        below = ids[rows.max() - 2 : rows.max() + 8, columns.min() : columns.max() + 8]
        below[below == 0] = 2
    return ids


def issues(root: Path, **options) -> dict[str, list]:
    from beags_plugin.plugin.objects.check_masks import check_scene, data_options

    found: dict[str, list] = {}
    for issue in check_scene(data_options(root, **options)).issues:
        found.setdefault(issue.kind, []).append(issue)
    return found


def exchanged(ids: np.ndarray, *order: int) -> np.ndarray:
    return np.array([0, *order], np.uint8)[ids]


def test_good_masks_give_no_finding(tmp_path):
    assert issues(write_balls(tmp_path)) == {}


def test_views_that_cut_or_add_parts_are_named_by_the_points_that_they_saw(tmp_path, capsys):
    scene = write_balls(tmp_path / "scene", damaged)
    check = ["masks", "check", "--data", str(scene), "--output", str(tmp_path / "out")]
    main(check)
    out = capsys.readouterr().out
    assert "No COLMAP model says which views saw which points" in out and "0 warnings" in out
    write_model(scene)
    main(check)
    out = " ".join(capsys.readouterr().out.split())
    assert "Views were compared at " in out and "2 warnings" in out
    assert re.search(r"1 of 12 masks of 1 \(left\) contradict .* worst first: v03 leaves out \d\d % of \d+ points", out)
    assert re.search(r"1 of 12 masks of 2 \(right\) contradict .* worst first: v07 takes in \d\d % of \d+ points", out)
    found = json.loads((tmp_path / "out/report.json").read_text())["contradictions"]
    assert {(one["view"], one["class_id"], one["of"]) for one in found} == {("v03", 1, "points"), ("v07", 2, "points")}
    with Image.open(tmp_path / "out/contradicted.png") as picture:
        assert picture.size[0] > 1200  # both views
    good = write_balls(tmp_path / "good")
    write_model(good)
    assert issues(good) == {}


def test_masks_that_are_made_are_compared_too(tmp_path, capsys):
    scene = write_balls(tmp_path / "scene", damaged)
    write_model(scene)
    (scene / "masks").rename(tmp_path / "ids")
    (scene / "classes.json").unlink()
    options = ["--source", "id-images", "--options", f"folder={tmp_path / 'ids'}", "--output", str(tmp_path / "out")]
    main(["masks", "make", "--data", str(scene), *options])
    assert "worst first: v03 leaves out" in capsys.readouterr().out and (tmp_path / "out/contradicted.png").is_file()


def test_damaged_masks_of_a_capture_are_named_and_no_others(tmp_path):
    from beags_plugin.plugin.objects.check_masks import check_scene, data_options
    from benchmarks.masks import damaged_mask

    root, generator = real("fruit"), np.random.default_rng(0)
    assert check_scene(data_options(root)).contradictions == []
    bad = set()
    for index, path in enumerate(sorted((root / "masks").iterdir())):
        mask = read_id_mask(path)
        if index % 4 == 1:
            mask = damaged_mask(mask, index % 8 == 1, generator)
            bad.add(path.stem)
        write_mask(tmp_path / path.name, mask)
    named = {one.view for one in check_scene(data_options(root, masks_path=tmp_path)).contradictions}
    assert named <= bad and len(named) >= 0.65 * len(bad)


def test_a_view_that_is_bad_blames_no_other():
    """Two views of four lack an object at points that few others saw: without them, nobody contradicts the rest."""
    labels = np.full((60, 6), UNSEEN, np.int16)
    labels[:, :3] = 1
    labels[:, 3] = 0
    labels[40:, 4] = 0
    labels[50:, :2] = UNSEEN  # there the bad views have the majority
    agreement = Agreement(labels, 2, least=2)
    views = [f"v{view}" for view in range(6)]
    assert {one.view for one in contradictions(agreement.confusion, views, [0, 7], "points")} == {"v2", "v3", "v4"}
    found = settle(agreement, views, [0, 7])
    assert [(one.view, one.class_id) for one in found] == [("v3", 7), ("v4", 7)]
    assert (found[0].missing, found[0].extra, found[0].total) == (50, 0, 50)


def test_exchanged_ids_are_found_with_the_view(tmp_path):
    plan = {3: (2, 1, 3), 9: (3, 1, 2)}
    found = issues(write_balls(tmp_path, lambda view, ids: exchanged(ids, *plan.get(view, (1, 2, 3)))))
    assert {issue.views for issue in found["swapped ids"]} == {("v03",), ("v09",)}
    pair = next(issue for issue in found["swapped ids"] if issue.views == ("v03",))
    assert "2 (right) instead of 1 (left), 1 (left) instead of 2 (right)" in pair.message
    assert f"1 masks ({tmp_path / 'masks/v03.png'})" in pair.message
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
    files = MaskFiles(names, [(1, 1)] * 12, masks, Path("masks"), "ids", (), used, None, Path())
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
    assert "id 255 is in 1 masks" in unknown and "--ignore-ids 255" in unknown
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
    assert words in out and "3 objects; 1 errors" in out


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


def test_contradicted_areas_are_wider_than_outlines():
    given = np.zeros((100, 100), np.int32)
    given[20:60, 20:60] = 1
    voted = given.copy()
    voted[20:60, 20] = 0  # an outline
    voted[70:90, 70:95] = 2
    sure = np.ones((100, 100), np.float32)
    (area,) = contradicted(given, voted, sure, "v")
    assert (area.given, area.voted, area.box) == (0, 2, (70, 70, 95, 90)) and 480 < area.pixels <= 500
    assert contradicted(given, voted, 0.5 * sure, "v") == []
    assert contradicted(np.full_like(given, IGNORE), voted, sure, "v") == []


def test_areas_that_a_run_contradicts_are_reported_with_their_cost(tmp_path):
    from beags_plugin.labels.label_maps import CompressedMaps, LabelMaps
    from beags_plugin.plugin.objects.check_masks import check_scene, check_with_run, data_options, write_contradictions

    def change(view, ids):
        blob = ids.copy()
        blob[2:12, 2:12] = 2
        return blob if view == 3 else ids

    root = write_balls(tmp_path, change)
    report = check_scene(data_options(root))
    good = [balls_from(pose).astype(np.int32) for pose in poses()]
    given = LabelMaps(torch.from_numpy(change(view, ids)) for view, ids in enumerate(good))
    voted = LabelMaps(map(torch.from_numpy, good))
    sure = CompressedMaps(torch.full((SIDE, SIDE), 255, dtype=torch.uint8) for _ in poses())
    maps = {"names": report.stems, "given": given, "voted": voted, "confidence": sure, "classes": report.names}

    def changed(view: int) -> Changed:
        shown = [found[view].numpy() for found in (given, voted, sure)]
        return Changed(report.stems[view], np.zeros((SIDE, SIDE, 3), np.uint8), *shown)

    found = check_with_run(report, cast(Any, SimpleNamespace(**maps, changed=changed)))
    (area,), (one,) = found.areas, found.contradictions
    assert (area.view, area.given, area.voted) == ("v03", 2, 0) and 60 < area.pixels <= 100
    assert (one.view, one.class_id, one.missing, one.extra) == ("v03", 2, 0, area.pixels)
    assert one.total == area.pixels + (good[3] == 2).sum()
    (issue,) = [issue for issue in found.issues if issue.kind == "contradicted"]
    assert "1 of 12 masks of 2 (right) contradict the other views at the run's depths" in issue.message
    assert issue.views == ("v03",) and issue.cost.startswith(f"{area.pixels} pixels ({percent(area.pixels, one.total)}")
    assert write_contradictions(found, tmp_path / "out")[0].is_file()
    same = check_with_run(report, cast(Any, SimpleNamespace(**{**maps, "given": voted})))
    assert same.areas == [] and same.contradictions == []


def test_words():
    assert named(range(7), 3) == "0, 1, 2 and 4 more" and named(["a", "b"]) == "a, b"
    assert percent(1, 3) == "33 %" and percent(1, 300) == "0.33 %" and percent(1, 0) == "0 %"


def test_coverage_picture_without_any_object(tmp_path):
    coverage_picture(tmp_path / "c.png", ["a"], [0, 1], {0: "b", 1: "c"}, np.zeros((1, 2)), np.array([False]))
    assert (tmp_path / "c.png").exists()
