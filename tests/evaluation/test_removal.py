"""Remains after an object is taken out, on opaque squares whose every pixel is known."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
import torch
from known_masks import BOX, CLASSES, CUP, FLOOR, SETTINGS, SIZE, Squares, camera, scene, square_mask
from rich.console import Console

from beags_plugin.core.membership import Membership
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import EvalView, SceneMetrics
from beags_plugin.evaluation.removal import TELLING
from beags_plugin.evaluation.report import CSV_COLUMNS, RunMetrics, data_set
from beags_plugin.evaluation.run_metrics import evaluate_scene
from beags_plugin.evaluation.table import render_data_set, render_run
from beags_plugin.losses.photometric import ssim_map

HIGH, LOW = 0.8, 0.3  # grey of the objects, of the floor
PIECE = (6.0, 10.0, 2.0)  # a quarter of the cup, before it


def picture(*squares: tuple[float, float, float], objects: float = HIGH) -> torch.Tensor:
    """Return [H, W, 3], the squares on the floor."""
    drawn = torch.full((SIZE, SIZE, 3), LOW)
    for square in squares:
        drawn[square_mask(*square)] = objects
    return drawn


def evaluated(squares, ids, removed, photo=None, silhouettes=None, objects=HIGH, known=None, **options) -> SceneMetrics:
    """Score the squares of grey ``objects`` and the floor behind them, in the view of the cup before the box."""
    surfels = scene([*squares, FLOOR])
    greys = torch.tensor([objects] * len(squares) + [LOW])
    surfels = replace(surfels, sh_dc=((greys - 0.5) / 0.28209479177387814)[:, None].expand(-1, 3).clone())
    silhouettes = {1: square_mask(*CUP), 2: square_mask(*BOX)} if silhouettes is None else silhouettes
    photo = picture(CUP, BOX, objects=objects) if photo is None else photo
    view = EvalView(camera(), photo, None, silhouettes, "v", removed=removed, removed_shown=known)
    ids = torch.tensor([*ids, 0], dtype=torch.int32)
    return evaluate_scene(surfels, Membership(ids), Squares(), SETTINGS, [view], CLASSES, **options)


def decibels(wrong_pixels: int, of: int, by: float = HIGH - LOW) -> float:
    return -10 * np.log10(wrong_pixels / of * by**2)


@pytest.mark.parametrize(
    ("squares", "ids", "taken", "psnr", "remains"),
    [
        ([PIECE, CUP], (1, 1), 1, None, 0.0),  # all of it is the cup's
        ([PIECE, CUP], (0, 1), 1, decibels(16, 64), 16 / 64),  # A piece stays, as it is the background's.
        ([PIECE, CUP], (2, 1), 1, decibels(16, 64), 16 / 64),  # A piece stays, as it is another object's.
        ([CUP], (0,), 1, decibels(64, 64), 1.0),  # nothing is taken out
        # the cup hides half of the box: those pixels count, but do not tell whether the box is there
        ([CUP, BOX], (1, 2), 2, None, 0.0),
        ([CUP, BOX], (1, 0), 2, decibels(32, 64), 1.0),
        ([CUP, BOX], (2, 2), 2, decibels(32, 64), 0.0),  # the cup is gone too, its half of the silhouette is wrong
    ],
)
def test_figures_of_one_object(squares, ids, taken, psnr, remains):
    photo, rest = picture(*squares), picture(*([CUP] if taken == 2 else []))
    found = evaluated(squares, ids, {taken: rest}, photo)
    removal = found.objects[taken].removal
    assert removal is not None and removal == found.mean.removal and found.objects[3 - taken].removal is None
    assert removal.psnr == pytest.approx(psnr) if psnr else removal.psnr > 100
    assert removal.remains == remains
    drawn = picture(*(square for square, class_id in zip(squares, ids, strict=True) if class_id != taken))
    similar = ssim_map(drawn, rest)[square_mask(*(CUP if taken == 1 else BOX))].mean()
    assert removal.ssim == pytest.approx(float(similar), abs=1e-5)


def test_what_photos_show_is_scored_apart():
    """A piece stays in the half of the cup behind which photos see; that mask is twice as large as the pictures."""
    half = (square_mask(*CUP) & square_mask(*PIECE[:2], 4.0)).repeat_interleave(2, 0).repeat_interleave(2, 1)
    for known, psnr, share in ((half, decibels(16, 36), 36 / 64), (half & False, None, 0.0), (None, None, None)):
        known = None if known is None else {1: known}
        removal = evaluated([PIECE, CUP], (0, 1), {1: picture()}, picture(PIECE, CUP), known=known).mean.removal
        assert removal is not None and removal.shown == share and removal.psnr == pytest.approx(decibels(16, 64))
        assert removal.psnr_shown == (None if psnr is None else pytest.approx(psnr))


def test_pixels_that_do_not_tell_are_no_remains():
    for step, remains in ((0.9 * TELLING / 3**0.5, None), (1.1 * TELLING / 3**0.5, 1.0)):
        removal = evaluated([CUP], (0,), {1: picture()}, picture(CUP, objects=LOW + step), objects=LOW + step).mean
        assert removal.removal is not None and removal.removal.remains == remains
        assert removal.removal.psnr == pytest.approx(decibels(64, 64, step), abs=1e-3)


def test_the_nearer_of_two_pictures_decides():
    """The object over the floor counts as gone at an opacity of 40 % and as there at 60 %."""
    for share, remains in ((0.4, 0.0), (0.6, 1.0)):
        objects = LOW + share * (HIGH - LOW)
        removal = evaluated([CUP], (0,), {1: picture()}, picture(CUP), objects=objects).mean.removal
        assert removal is not None and removal.remains == remains


@pytest.mark.parametrize(
    ("removed", "options"),
    [
        (None, {}),  # all real captures are like this
        ({1: picture()}, {"complete": False}),  # a part of a scene
        ({1: picture()}, {"silhouettes": {2: square_mask(*BOX)}}),  # nobody knows where it was
        ({3: picture()}, {}),  # no such class
    ],
)
def test_nothing_is_scored_without_what_it_needs_and_no_table_speaks_of_it(removed, options):
    found = evaluated([CUP, BOX], (1, 2), removed, **options)
    assert found.mean.removal is None and {mask.kind for mask in found.masks} <= {"extracted", "rendered"}
    run = RunMetrics("lab", "c", Protocol(), CLASSES, found, found)
    assert "emov" not in printed(render_run(run)) + printed(render_data_set(data_set("labs", [run, run])))


def test_an_object_out_of_the_view_has_no_figures():
    found = evaluated([CUP], (1,), {1: picture()}, silhouettes={1: torch.zeros(SIZE, SIZE, dtype=torch.bool)})
    assert found.mean.removal is not None and found.mean.removal.psnr is found.mean.removal.remains is None


def printed(table) -> str:
    out = io.StringIO()
    Console(file=out, width=80).print(table)
    return out.getvalue()


def exposed(picture: torch.Tensor) -> torch.Tensor:
    """Return a picture with less light and another white balance."""
    return picture * torch.tensor([0.5, 0.6, 0.7]) + 0.3


def test_of_learned_exposures_the_photos_own_is_taken_off_before_remains_are_told():
    """The fit is that of the whole rendering, so that remains are not fitted away."""
    photo, rest = exposed(picture(PIECE, CUP)), {1: exposed(picture())}
    plain = evaluated([PIECE, CUP], (1, 1), rest, photo)
    fitted = evaluated([PIECE, CUP], (1, 1), rest, photo, colors_fitted=True)
    assert plain.mean.removal.psnr < 20 and fitted.mean.removal.psnr > 80
    assert fitted.mean.removal.ssim > 0.9999 > plain.mean.removal.ssim
    assert fitted.mean.removal.remains == 0.0
    assert fitted.psnr == plain.psnr < 20 and fitted.psnr_fit == plain.psnr_fit > 80
    # Remains are told as without the exposure.
    stays = evaluated([PIECE, CUP], (0, 1), rest, photo, colors_fitted=True).mean.removal
    assert stays.remains == 16 / 64 and stays.psnr == pytest.approx(decibels(16, 64) + 4.4, abs=0.5)
    nothing = evaluated([CUP], (0,), rest, exposed(picture(CUP)), colors_fitted=True).mean.removal
    assert nothing.remains == 1.0


def test_tables_and_files_show_removals_before_and_after():
    before, after = (evaluated([PIECE, CUP, BOX], (ids, 1, 2), {1: picture(BOX)}) for ids in (0, 1))
    run = RunMetrics("lab", "c", Protocol(), CLASSES, before, after)
    wrong = f"{before.mean.removal.psnr:.2f}"
    assert wrong == f"{decibels(16, 64):.2f}"
    content = run.to_json()
    remains = 16 / 32  # the cup's right half stands before the box, which is as grey
    assert content["objects"]["cup"]["removal"]["before"]["remains"] == remains
    assert content["masks"][-1]["before"]["remains"] == remains
    assert content["mean"]["removal"]["after"]["remains"] == 0.0 and content["masks"][-1]["kind"] == "removal"
    for table in (render_run(run), render_data_set(data_set("labs", [run, run]))):
        lines = [line.split() for line in printed(table).splitlines()]
        assert any(line[1:3] == ["before", wrong] and line[-1] == "50.0" for line in lines)
        text = " ".join(printed(table).split())
        assert "objects removed" in text and f"where the two differ by {TELLING:g} or more" in text
    (row, *_) = data_set("labs", [run]).csv_rows()
    assert len(row) == len(CSV_COLUMNS) and row[CSV_COLUMNS.index("removal_remains")] == remains
