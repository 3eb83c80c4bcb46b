"""The contact sheet has no empty cell, shows objects with the photos' pixels, and hides no side that went wrong."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from known_masks import BOX, CLASSES, CUP, FLOOR, SETTINGS, SIZE, Squares, camera, scene, truth
from PIL import Image
from test_turntable import HIGH, LOW, ball

from beags_plugin.core.cameras import Camera, cropped
from beags_plugin.core.surfels import Surfels
from beags_plugin.evaluation.records import EvalView, FullPhoto
from beags_plugin.pictures.cells import GAP, write_picture
from beags_plugin.pictures.contact_sheet import contact_sheet
from beags_plugin.pictures.object_cells import (
    COLUMNS,
    LARGEST,
    SMALLEST,
    STRAYS,
    Drawing,
    cell_size,
    object_shots,
    views_of,
)
from beags_plugin.pictures.orbit import least_shown, orbit, orbit_frame, orbit_settings, side, unshown, view_from
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.system.errors import UserError

SQUARES = Drawing(Squares(), SETTINGS)
STAND = orbit_frame(*(torch.tensor([sign * 1.0] * 3) for sign in (-1, 1)))
BALLS = Drawing(make_rasterizer("auto"), orbit_settings(STAND))


def photos(elevation: float = 20.0, turn: float = 360.0, count: int = 8, pixels: int = 64) -> list[Camera]:
    return orbit(STAND, count, pixels, elevation, turn)


def views(*, full: int = 1) -> list[EvalView]:
    """Return views around a ball; ``full`` says how much larger the photos' files are."""
    found = []
    generator = torch.Generator().manual_seed(0)
    for number, seen in enumerate(photos(count=4)):
        image = torch.rand(seen.height, seen.width, 3, generator=generator)
        view = EvalView(seen, image, name=f"v{number}")
        if full > 1:
            K = seen.K * torch.tensor([[full], [full], [1.0]])
            large = Camera(seen.viewmat, K, full * seen.width, full * seen.height)
            photo = torch.rand(large.height, large.width, 3, generator=generator)

            def region(box, large=large, photo=photo):
                left, top, right, bottom = box
                return cropped(large, left, top, right - left, bottom - top), photo[top:bottom, left:right]

            view = replace(view, full=FullPhoto(large, region))
        found.append(view)
    return found


def joined(*parts: Surfels) -> Surfels:
    return Surfels(*(torch.cat(values) for values in zip(*(vars(part).values() for part in parts), strict=True)))


def moved(surfels: Surfels, *by: float, size: float = 1.0) -> Surfels:
    means = size * surfels.means + torch.tensor(by)
    return replace(surfels, means=means, log_scales=surfels.log_scales + math.log(size))


def cells(picture: np.ndarray, size: int) -> list[list[np.ndarray]]:
    """Return the lines of square cells of a picture, without captions."""
    high = size + 18 + GAP
    return [
        [picture[y + 18 : y + 18 + size, x : x + size] for x in range(0, picture.shape[1] - size + 1, size + GAP)]
        for y in range(0, picture.shape[0] - size, high)
    ]


def object_cells(*words) -> np.ndarray:
    """Return the cells of an object alone."""
    shots = object_shots(*words)
    return shots.cells(cell_size([shots]), words[-1])


@pytest.mark.parametrize("masked", [True, False])
def test_a_sheet_has_full_lines_and_no_empty_cell(tmp_path, masked):
    squares = [scene([each], grey=grey) for each in (CUP, BOX) for grey in (0.3, 0.6)]
    objects = {1: {"before": squares[0], "after": squares[1]}, 2: {"before": squares[2], "after": squares[3]}}
    held_out = [
        EvalView(camera(s), torch.rand(SIZE, SIZE, 3), truth() if masked else None, name=f"view {s}")
        for s in (0.0, 1.0, 2.0)
    ]
    counts: list[tuple[int, int]] = []
    sheet = contact_sheet(
        held_out, [camera()], scene([CUP, BOX, FLOOR]), objects, CLASSES, SQUARES,
        progress=lambda *steps: counts.append(steps),
    )  # fmt: skip
    shown = 2 if masked else 3
    assert counts == [(n + 1, 2 + shown) for n in range(2 + shown)]
    size = sheet.shape[1] // COLUMNS - GAP
    line = cells(sheet, size)[0]
    assert len(line) == COLUMNS and not any((cell == 255).all() for cell in line)
    assert all((sheet == grey).all(axis=-1).sum() > 50 for grey in (76, 153))
    write_picture(tmp_path / "out/sheet.png", sheet)
    with Image.open(tmp_path / "out/sheet.png") as picture:
        assert np.array_equal(np.asarray(picture), sheet)


@pytest.mark.parametrize("masks", [0, 1])
@pytest.mark.parametrize("count", [0, 1, 2, 4])
@pytest.mark.parametrize("stages", [{"before": 0.3, "after": 0.6}, {"before": 0.3}])
def test_lines_are_full_however_few_views_are_held_out(count, masks, stages):
    held_out = views(full=8)[:count]
    held_out[:masks] = [replace(view, visible=torch.ones(64, 64, dtype=torch.int64)) for view in held_out[:masks]]
    objects = {1: {stage: ball(grey) for stage, grey in stages.items()}}
    sheet = contact_sheet(held_out, photos(), ball(), objects, {1: "ball"}, BALLS)
    white = (sheet == 255).all(axis=-1)
    edge = white[:, -3 * GAP : -2 * GAP].all(axis=1)
    assert edge.mean() < 0.15  # captions and gaps
    assert np.diff(np.flatnonzero(~edge)).max() < 40
    assert sheet.shape[1] <= COLUMNS * (LARGEST + GAP) and sheet.shape[0] < 1.6 * sheet.shape[1]


def test_an_object_fills_two_lines_and_has_the_pixels_of_the_photos_files():
    held_out = views(full=6)
    sheet = object_cells(1, "ball", {"before": ball(), "after": ball(0.2)}, held_out, photos(), BALLS)
    size = sheet.shape[1] // COLUMNS - GAP
    assert SMALLEST < size < 6 * 64 * 1.4
    lines = cells(sheet, size)
    assert [len(line) for line in lines] == [COLUMNS, COLUMNS]
    assert all(cell.std() > 1 for line in lines for cell in line)
    regions = [view.full.region((0, 0, 384, 384))[1] for view in held_out if view.full is not None]
    rows = [row.tobytes() for image in regions for row in (image * 255).round().byte().numpy()]
    photo = lines[0][0]
    inside = photo[(photo < 255).any(axis=(1, 2))]
    assert len(inside) > 150 and all(any(_colours(row) in each for each in rows) for row in inside)  # none resized


def test_lines_of_objects_of_different_size_end_together():
    sizes = (0.4, 0.7, 1.0)
    objects = {
        i: {"before": moved(ball(), 0.0, 0.0, 0.0, size=size), "after": moved(ball(0.2), 0.0, 0.0, 0.0, size=size)}
        for i, size in enumerate(sizes, start=1)
    }
    shots = [object_shots(i, f"object {i}", stages, views(full=8), photos(), BALLS) for i, stages in objects.items()]
    assert shots[0].pixels < shots[1].pixels < shots[2].pixels and cell_size(shots) == shots[1].pixels
    sheet = contact_sheet(views(full=8), photos(), ball(), objects, {}, BALLS)
    blocks = [each.cells(cell_size(shots), BALLS) for each in shots]
    assert len({block.shape for block in blocks}) == 1
    high, wide, _ = blocks[-1].shape
    assert np.array_equal(sheet[-high - GAP : -GAP, :wide], blocks[-1])


def test_photos_are_as_wide_as_the_cells_of_objects():
    held_out, (high, wide) = views(full=1), (96, 64)
    upright = [replace(each, image=torch.rand(high, wide, 3), visible=None) for each in held_out]
    upright = [replace(each, camera=replace(each.camera, width=wide, height=high)) for each in upright]
    for shown in (held_out, upright):
        sheet = contact_sheet(shown, photos(), ball(), {1: {"before": ball(), "after": ball(0.2)}}, {}, BALLS)
        assert sheet.shape[1] == COLUMNS * (SMALLEST + GAP)
        lines = sheet[18 : 18 + SMALLEST], sheet[-GAP - SMALLEST : -GAP]
        assert all((line[:, -3 * GAP : -2 * GAP] < 255).any() for line in lines)


def _colours(row: np.ndarray) -> bytes:
    """Return the pixels of a row without the white ones, which lie beside the photo."""
    return row[(row < 255).any(axis=1)].tobytes()


def test_a_small_object_is_enlarged_and_a_large_one_reduced():
    for full, size in ((1, SMALLEST), (12, LARGEST)):
        stages = {"before": ball(), "after": ball()}
        sheet = object_cells(1, "ball", stages, views(full=full), photos(), BALLS)
        assert sheet.shape[0] % (size + 18 + GAP) == 0, full


def black(cell: np.ndarray) -> float:
    """Return the share of the pixels that are black, as chips are."""
    return float((cell.max(axis=-1) < 30).mean())


def test_what_hides_below_the_object_or_behind_it_is_shown():
    chip = moved(ball(0.0), 0.0, 0.0, -1.3, size=0.3)  # photos from above do not show it
    behind = moved(ball(0.0), 0.0, 0.9, 0.6, size=0.4)
    front = photos(elevation=60.0, turn=90.0)
    for extra, expected in ((chip, (0, 2)), (behind, (4,))):
        sheet = object_cells(1, "ball", {"before": ball(), "after": joined(ball(), extra)}, [], front, BALLS)
        (line,) = cells(sheet, LARGEST)
        shares = [black(cell) for cell in line]
        assert all(share < 0.001 for share in shares[::2])  # cells before refinement
        assert all(shares[place + 1] > 0.01 for place in expected), shares


def test_a_stray_far_from_the_object_is_in_the_picture():
    stray = moved(ball(0.0, count=1), 0.0, 0.0, -2.6, size=0.5)  # It lies beyond the box, which strays do not widen.
    stages = {"before": ball(), "after": joined(ball(), stray)}
    (line,) = cells(object_cells(1, "ball", stages, [], photos(), BALLS), LARGEST)
    assert all(black(cell) > 0.00005 for cell in line[1::2])
    assert not any(black(cell) for cell in line[::2])


def test_a_stray_that_refinement_removed_does_not_make_the_object_small():
    stray = moved(ball(0.0, count=1), 0.0, 0.0, -2.6, size=0.5)
    plain = {"before": ball(0.0), "after": ball(0.0)}
    (line,), (other,) = (
        cells(object_cells(1, "ball", stages, [], photos(), BALLS), LARGEST)
        for stages in (plain, {**plain, "before": joined(ball(0.0), stray)})
    )
    for full, small in zip(line[1::2], other[1::2], strict=True):
        assert 0 < black(full) / STRAYS**2 < 1.1 * black(small)


def test_views_of_an_object_are_the_one_that_shows_it_largest_and_one_from_the_other_side():
    def seen(azimuth: float, room: float) -> EvalView:
        return EvalView(view_from(STAND, side(STAND, azimuth, 20.0), 64, room), None)

    beside = EvalView(cropped(photos()[0], 500, 0, 64, 64), None)  # the object is not in it
    cut = EvalView(cropped(photos()[0], 20, 0, 64, 64), None)
    held_out = [beside, seen(0.0, 2.0), seen(200.0, 2.0), seen(30.0, 1.2), seen(90.0, 1.5), cut]
    assert views_of(STAND, held_out) == [3, 2]
    assert views_of(STAND, [beside, cut, held_out[1]]) == [2, 1]
    assert views_of(STAND, held_out[:1]) == []


def test_the_side_least_shown_is_the_one_without_photos():
    stand = orbit_frame(LOW, HIGH)
    for gap in (40.0, 180.0, 300.0):
        seen = [view_from(stand, side(stand, gap + turn, 25.0), 32) for turn in range(50, 311, 20)]
        assert least_shown(stand, seen, 10.0) == pytest.approx(gap, abs=5)
        assert unshown(stand, seen) == 0
        for elevation in (0.0, 50.0):
            some = [view_from(stand, side(stand, gap + turn, elevation), 32) for turn in range(120, 241, 20)]
            assert unshown(stand, some) == pytest.approx(360 - 120 - 2 * 60, abs=10)
        assert unshown(stand, [view_from(stand, side(stand, gap, 80.0), 32)]) == 0, "from above it sees all sides"
    assert least_shown(stand, [], 10.0) == 180.0 and unshown(stand, []) == 0
    away = [cropped(seen, 500, 0, 32, 32) for seen in orbit(stand, 4, 32)]
    assert least_shown(stand, away, 10.0) == 180.0


def test_a_sheet_survives_absent_parts_but_not_a_place_that_cannot_be_written(tmp_path):
    held_out = [EvalView(camera(), None, name="an → name")]
    nothing = {1: {"before": scene([CUP])[:0], "after": scene([CUP])[:0]}}
    options = ([camera()], scene([CUP]))
    assert contact_sheet(held_out, *options, nothing, {1: "Tasse ☕"}, SQUARES).dtype == np.uint8
    assert contact_sheet([], *options, {1: {"after": scene([CUP])}}, {1: "Tasse ☕"}, SQUARES).dtype == np.uint8
    with pytest.raises(ValueError, match="a view or an object"):
        contact_sheet([], *options, nothing, {}, SQUARES)
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        write_picture(tmp_path / "file" / "sheet.png", np.zeros((4, 4, 3), np.uint8))
