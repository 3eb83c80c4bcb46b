"""Masks that lack parts of an object or take in too much are found by what the other views say, the worst first."""

from __future__ import annotations

import json
import re
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from ball_scenes import SIDE, balls_from, issues, poses, write_balls, write_model
from damaged_parts import damaged_mask
from data_folders import write_image
from parsed_views import real
from PIL import Image

from beags_plugin.commands.cli import main
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.classes import read_id_mask, write_mask
from beags_plugin.masks.check.consistency import UNSEEN, Agreement
from beags_plugin.masks.check.contradictions import contradicted, settle
from beags_plugin.masks.check.issues import percent
from beags_plugin.pictures.masks import Changed, Pointed, contradicted_picture


def damaged(view: int, ids: np.ndarray) -> np.ndarray:
    """Cut the lower half of ball 1 off in view 3, and add ground to ball 2 in view 7."""
    rows, columns = np.nonzero(ids == {3: 1, 7: 2}.get(view, 3))
    if view == 3:
        ids[rows[rows >= np.median(rows)], columns[rows >= np.median(rows)]] = 0
    if view == 7:
        below = ids[rows.max() - 2 : rows.max() + 8, columns.min() : columns.max() + 8]
        below[below == 0] = 2
    return ids


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
    assert re.search(
        r"1 of 12 masks of 1 \(left\) contradicts .* worst first: v03 leaves out \d\d % of \d+ points", out
    )
    assert re.search(r"1 of 12 masks of 2 \(right\) contradicts .* worst first: v07 takes in \d\d % of \d+ points", out)
    found = json.loads((tmp_path / "out/report.json").read_text())["contradictions"]
    assert {(one["view"], one["class_id"], one["of"]) for one in found} == {("v03", 1, "points"), ("v07", 2, "points")}
    with Image.open(tmp_path / "out/contradicted.png") as picture:
        assert picture.size[0] > 1200  # It shows both views.
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


@pytest.mark.slow("a capture of 60 views with masks damaged in several ways")
def test_damaged_masks_of_a_capture_are_named_and_no_others(tmp_path):
    from beags_plugin.objects.check_masks import check_scene, data_options

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
    labels[50:, :2] = UNSEEN  # At these points the bad views have the majority.
    agreement = Agreement(labels, 2, least=2)
    assert agreement.confusion[2, 0, 1] == 10  # At these points they blame a good view.
    found = settle(agreement, [f"v{view}" for view in range(6)], [0, 7])
    assert [(one.view, one.class_id) for one in found] == [("v3", 7), ("v4", 7)]
    assert (found[0].missing, found[0].extra, found[0].total) == (50, 0, 50)


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
    from beags_plugin.objects.check_masks import add_areas, check_scene, data_options, write_contradictions

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

    add_areas(report, cast(Any, SimpleNamespace(**maps | {"given": voted})))
    assert report.areas == [] and report.contradictions == []
    add_areas(report, cast(Any, SimpleNamespace(**maps, changed=changed)))
    (area,), (one,) = report.areas, report.contradictions
    assert (area.view, area.given, area.voted) == ("v03", 2, 0) and 60 < area.pixels <= 100
    assert (one.view, one.class_id, one.missing, one.extra) == ("v03", 2, 0, area.pixels)
    assert one.total == area.pixels + (good[3] == 2).sum()
    (issue,) = [issue for issue in report.issues if issue.kind == "contradicted"]
    assert "1 of 12 masks of 2 (right) contradicts the other views at the run's depths" in issue.message
    assert issue.views == ("v03",) and issue.cost.startswith(f"{area.pixels} pixels ({percent(area.pixels, one.total)}")
    assert write_contradictions(report, tmp_path / "out")[0].is_file()


def test_points_are_drawn_where_they_are_in_photos_of_any_size(tmp_path):
    views = []
    for name, (height, width) in {"tall": (600, 300), "wide": (300, 600)}.items():
        write_image(tmp_path / f"{name}.png", np.full((height, width, 3), 90, np.uint8))
        place = np.array([[0.25, 0.75]])
        views.append(Pointed(name, tmp_path / f"{name}.png", np.ones((height, width), np.uint16), place, np.array([0])))
    contradicted_picture(tmp_path / "out.png", views, [])
    with Image.open(tmp_path / "out.png") as picture:
        black = np.asarray(picture.convert("L"))[18:] == 0
    dots = (np.nonzero(half) for half in (black[:, :600], black[:, 604:]))
    found = {(round(np.median(x)), round(np.median(y))) for y, x in dots}
    assert {(150, 900), (150, 225)} == found
