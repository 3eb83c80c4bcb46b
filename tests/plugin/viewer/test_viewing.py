"""Parts of the viewer without nerfstudio: choices of objects, picking, pictures, the legend's text."""

from __future__ import annotations

import json
import math
import re
from dataclasses import fields

import numpy as np
import pytest
import torch
from run_folders import discs

from beags_plugin.core.cameras import Camera
from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels, opacities
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.colors import colorize
from beags_plugin.plugin.viewer.aim import frame_of, place, side_of_photos
from beags_plugin.plugin.viewer.choice import Choice, visible_part
from beags_plugin.plugin.viewer.legend import (
    WORDS_APART,
    LegendRow,
    escaped,
    hex_color,
    legend,
    pasteable,
    swatch,
    unique_labels,
    wrapped,
)
from beags_plugin.plugin.viewer.pace import SECONDS, Pace
from beags_plugin.plugin.viewer.picking import camera_along, pick
from beags_plugin.plugin.viewer.pictures import (
    boundary_picture,
    class_picture,
    fitted_camera,
    framed,
    nearest_view,
)
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs

SETTINGS = RasterSettings(0.01, 100.0)


def view(width: int = 32, height: int = 24, distance: float = 3.0, turn: float = 0.0) -> Camera:
    """Return a view of the origin from ``distance`` away, from an angle ``turn`` about the y axis."""
    cos, sin = math.cos(turn), math.sin(turn)
    viewmat = torch.tensor([[cos, 0, sin, 0], [0, 1, 0, 0], [-sin, 0, cos, distance], [0, 0, 0, 1]])
    K = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]])
    return Camera(viewmat.float(), K.float(), width, height)


def wall(z: float, x: float = 0.0, scale: float = 0.3, opacity: float = 0.9) -> Surfels:
    """Return one disc that faces the z axis."""
    quat, log_scales = torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1, 2), math.log(scale))
    opacity_logits = torch.logit(torch.tensor([opacity]))
    return Surfels.of(torch.tensor([[x, 0.0, z]]), quat, log_scales, opacity_logits, torch.zeros(1, 1, 3))


def joined(*parts: Surfels) -> Surfels:
    return Surfels(*(torch.cat([getattr(part, one.name) for part in parts]) for one in fields(Surfels)))


# -- choices ---------------------------------------------------------------------------------------------------------


def test_nothing_chosen_shows_everything_without_copying():
    surfels, ids = discs()
    scene = visible_part(surfels, Membership(ids), Choice(faded_opacity=0.3))
    assert scene.surfels is surfels and scene.index is None


@pytest.mark.parametrize(
    ("choice", "classes"),
    [
        (Choice().isolate(1), {1}),
        (Choice().hide(1), {0, 2}),
        (Choice().hide(1).show(1), {0, 1, 2}),
        (Choice().remove(0).hide(2), {1}),
        (Choice().hide(1).isolate(1), {1}),
        (Choice().isolate(1).isolate(2), {2}),
        (Choice().isolate(1).show(2), {0, 1, 2}),
        (Choice().isolate(1).hide(1), {0, 2}),
        (Choice().isolate(1).remove(2), {1}),
        (Choice().remove(1).hide(2).isolate(0).show_all(), {0, 1, 2}),
        (Choice().remove(0).remove(1).remove(2), set()),
        (Choice().isolate(7), set()),
    ],
)
def test_choices_leave_these_classes(choice, classes):
    surfels, ids = discs()
    scene = visible_part(surfels, Membership(ids), choice)
    index = torch.arange(len(ids)) if scene.index is None else scene.index
    assert set(scene.class_ids.tolist()) == classes
    assert index.tolist() == [i for i, class_id in enumerate(ids.tolist()) if class_id in classes]
    assert torch.equal(scene.surfels.means, surfels.means[index])
    assert {c for c in (0, 1, 2) if choice.in_full(c)} == classes
    assert {c for c in (0, 1, 2) if choice.state(c) == "shown"} == classes


def test_the_rest_fades_and_what_is_removed_stays_away():
    surfels, ids = discs()
    choice = Choice(faded_opacity=0.25).isolate(1).remove(2)
    scene = visible_part(surfels, Membership(ids), choice)
    before = opacities(surfels.opacity_logits)[scene.index]
    factor = torch.where(scene.class_ids == 1, 1.0, 0.25)
    assert set(scene.class_ids.tolist()) == {0, 1}
    torch.testing.assert_close(opacities(scene.surfels.opacity_logits), before * factor, rtol=1e-5, atol=1e-6)
    assert set(visible_part(surfels, Membership(ids), choice, rest=False).class_ids.tolist()) == {1}
    assert visible_part(surfels, Membership(ids), Choice(faded_opacity=1.0).hide(1)).surfels.opacity_logits.equal(
        surfels.opacity_logits
    )


def test_the_least_opacity_and_a_crop_box_leave_surfels_out():
    surfels = joined(wall(0.0, opacity=0.2), wall(1.0, opacity=0.6), wall(2.0, opacity=0.9))
    ids = torch.tensor([0, 1, 1], dtype=torch.int32)
    assert visible_part(surfels, Membership(ids), Choice(min_opacity=0.5)).index.tolist() == [1, 2]
    inside = torch.tensor([True, True, False])
    assert visible_part(surfels, Membership(ids), Choice(min_opacity=0.5), inside=inside).index.tolist() == [1]
    assert visible_part(surfels, Membership(ids), Choice(min_opacity=1.0)).index.tolist() == []


# -- picking -----------------------------------------------------------------------------------------------------------


def test_the_ray_of_a_pixel_picks_what_the_whole_picture_has_there(rasterizer):
    """Same surfel as ``dominant_gaussian`` of a whole view whose pixels are as fine as the one that picking draws."""
    surfels, _ = discs()
    K = torch.tensor([[1000.0, 0, 12.0], [0, 1000.0, 10.0], [0, 0, 1]])
    for turn, lift in ((0.0, 0.0), (0.7, 0.2), (2.0, -0.1)):
        viewmat = view(turn=turn).viewmat.clone()
        viewmat[1, 3] += lift
        camera = Camera(viewmat, K, 24, 20)
        whole = rasterizer.dominant_gaussian(geometry_inputs(surfels), camera, SETTINGS)
        for x, y in ((3, 4), (12, 10), (20, 15)):
            local = torch.tensor([(x + 0.5 - 12.0) / 1000, (y + 0.5 - 10.0) / 1000, 1.0])
            direction = (camera.rotation.T @ local).tolist()
            found = pick(rasterizer, surfels, SETTINGS, camera.center.tolist(), direction)
            assert (-1 if found is None else found) == int(whole[y, x])


def test_picking_takes_the_heaviest_not_the_nearest(rasterizer):
    both = joined(wall(0.0, opacity=0.2), wall(1.0, opacity=0.9))
    towards = ((0.0, 0.0, -3.0), (0.0, 0.0, 2.0))
    assert pick(rasterizer, both, SETTINGS, *towards) == 1
    assert pick(rasterizer, both, SETTINGS, (9.0, 0.0, -3.0), (0.0, 0.0, 1.0)) is None
    assert pick(rasterizer, both[torch.zeros(0, dtype=torch.int64)], SETTINGS, *towards) is None


@pytest.mark.parametrize("direction", [(0, 0, 1), (0, -1, 0), (1, 0, 0), (0.3, -5.0, 2.0)])
def test_the_pixel_of_picking_looks_along_the_ray(direction):
    camera = camera_along((1.0, 2.0, 3.0), direction)
    point = torch.tensor([1.0, 2.0, 3.0]) + 4.0 * torch.nn.functional.normalize(torch.tensor(direction).float(), dim=0)
    local = camera.rotation @ point + camera.translation
    torch.testing.assert_close(local, torch.tensor([0.0, 0.0, 4.0]), rtol=0, atol=1e-5)
    assert float(torch.linalg.det(camera.rotation)) == pytest.approx(1.0, abs=1e-5)


# -- pictures ----------------------------------------------------------------------------------------------------------


def test_a_boundary_picture_is_the_share_of_another_class(rasterizer):
    """One disc: the weight of its pixel where the mask says another class, 0 where it agrees or says nothing."""
    surfels, ids, camera = wall(0.0), torch.tensor([3], dtype=torch.int32), view()
    alpha = rasterizer.rasterize(geometry_inputs(surfels), camera, SETTINGS, torch.zeros(3)).alpha
    mask = torch.full((24, 32), 3, dtype=torch.int32)
    mask[:, 16:], mask[20:] = 1, IGNORE
    picture = boundary_picture(rasterizer, surfels, ids, camera, SETTINGS, mask)
    assert picture.shape == (24, 32, 1) and picture.dtype == torch.float32
    torch.testing.assert_close(picture[..., 0], torch.where(mask == 1, alpha, torch.zeros(())))


def test_class_pictures_have_the_colours_of_the_ids():
    ids = torch.tensor([[0, 1], [700, IGNORE]], dtype=torch.int32)
    assert np.array_equal((255 * class_picture(ids)).round().byte().numpy(), colorize(ids.numpy()))


@pytest.mark.parametrize(("width", "height"), [(100, 40), (40, 100), (7, 5), (1, 1), (300, 2)])
def test_a_view_fits_into_any_picture_and_sees_the_same(width, height):
    camera = view(32, 24)
    fitted = fitted_camera(camera, width, height)
    assert 1 <= fitted.width <= width and 1 <= fitted.height <= height
    assert fitted.width == width or fitted.height == height
    corner = torch.tensor([0.5 * 32, 0.25 * 24, 1.0])  # The corner has the same place in both views.
    ray = torch.linalg.inv(camera.K) @ corner
    there = fitted.K @ ray
    assert there.tolist() == pytest.approx([0.5 * fitted.width, 0.25 * fitted.height, 1.0], rel=1e-5)
    picture = torch.ones(fitted.height, fitted.width, 3)
    frame = framed(picture, width, height)
    assert frame.shape == (height, width, 3) and float(frame.sum()) == picture.numel()


def test_the_nearest_view_is_near_and_looks_the_same_way():
    views = [view(turn=turn) for turn in (0.0, 1.0, 2.0, 3.0)]
    assert nearest_view(view(turn=1.9), views, 3.0) == 2
    behind = Camera(torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ views[0].viewmat, views[0].K, 32, 24)
    assert nearest_view(view(turn=0.4), [behind, views[1]], 3.0) == 1


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.0])
def test_a_camera_at_its_place_sees_all_objects_from_the_side_of_a_photo(aspect):
    """Turned about y towards the middle: view 1 looks straight at it, the others past it."""
    surfels, ids = discs()
    views = [view(turn=1.0), view(turn=2.0)]
    views[0] = Camera(torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ views[0].viewmat, views[0].K, 32, 24)
    frame = frame_of(surfels, Membership(ids), [1, 2], views)
    away = side_of_photos(frame, views)
    torch.testing.assert_close(away, views[1].center.double() - frame.center)
    eye = place(frame, away, 0.9, aspect)
    camera = camera_along(eye.tolist(), (frame.center - eye).tolist())
    local = (surfels.means[ids > 0] - eye.float()) @ camera.rotation.T
    # camera_along may lie on its side: both directions are held to the smaller one
    assert bool((local[:, :2].abs().amax(1) < math.tan(0.45) * min(aspect, 1.0) * local[:, 2]).all())
    assert float((local[:, :2].norm(dim=1) / local[:, 2]).max()) > 0.3 * math.tan(0.45) * min(aspect, 1.0)


@pytest.mark.parametrize(
    ("fixed", "each", "height"),
    [(0.0, 1e-6, 181), (0.03, 1e-7, 362), (0.3, 5e-7, 256), (0.3, 2e-5, 128), (0.001, 1e-9, 400), (0.0, 1e-3, 32)],
)
def test_pictures_are_as_large_as_the_pace_allows(fixed, each, height):
    """A picture takes ``fixed`` seconds and ``each`` per pixel: as many pixels as fit, no fewer if that gains little.

    The processor's time is longer for the first picture; the still pictures between are of another size.
    """
    pace, seen = Pace(), []
    for index in range(80):
        seen.append(pace.size(1.25, 500))
        spent = fixed + each * seen[-1][0] * seen[-1][1]
        pace.took(seen[-1][0] * seen[-1][1], 9, spent, 2 * spent + (index == 0))
        pace.took(500 * 400, 9, 1e-6, 1e-6)
    assert seen[-20:] == [(height, int(1.25 * height))] * 20
    assert fixed + each * 1.25 * height**2 < SECONDS or fixed > SECONDS or height == 32


# -- text --------------------------------------------------------------------------------------------------------------


def test_the_legend_names_colours_counts_and_states():
    rows = [LegendRow(1, "red cup", 1234), LegendRow(2, "box", 5, "hidden"), LegendRow(3, "lid", 6, "removed")]
    lines = legend(rows).splitlines()
    assert len(lines) == 5
    red, green, blue = colorize(np.array([[1]]))[0, 0]
    assert hex_color(1) == f"#{red:02x}{green:02x}{blue:02x}" and f'background: "{hex_color(1)}"' in lines[2]
    assert "`" not in lines[2]  # the page would write the colour's code beside its square
    assert "| red cup |" in lines[2] and "1,234" in lines[2]
    assert "| ~~box~~ |" in lines[3] and "| ~~lid~~ removed |" in lines[4]


def test_no_name_can_be_taken_for_a_program():
    name = "äö 猫 {alert(1)} <b>|a| `x` [y](z)*w*_v_\\ \n"
    text = legend([LegendRow(1, name, 1)])
    assert len(text.splitlines()) == 3  # a line end would break the table
    row = text.splitlines()[2]
    assert row.count("|") == 4 and not set("{}<>[]*_\\") & set(row.replace(swatch(1), ""))
    assert "äö 猫" in row and "&#123;alert&#40;1&#41;&#125;" in row
    assert escaped("a.b") == "a.b"


ODD = "ns-train --data '/a  b/{x}<b>\"![y](z)' `q`"


def test_a_text_is_shown_as_it_is_and_its_longest_word_breaks():
    page = wrapped(ODD)
    assert "overflowWrap" in page and "![" not in page and page.count("<") == 2
    inner = page.partition(">{")[2].rpartition("}</")[0]
    assert json.loads(inner) == ODD  # a string of JavaScript


def test_a_command_is_shown_word_by_word_so_that_no_option_is_torn():
    page = pasteable(ODD)
    assert "overflowWrap" in page and "![" not in page
    inner = re.fullmatch(r"<pre style=\{\{[^}]*\}\}>(.*)</pre>", page)[1]
    spans = [re.fullmatch(r"(?:<span [^>]*>\{(.*)\}</span>)?", part)[1] for part in inner.split(WORDS_APART)]
    assert " ".join(json.loads(span) if span else "" for span in spans) == ODD


def test_labels_are_unique_never_empty_and_in_the_order_of_ids():
    labels = unique_labels({3: "cup", 1: "cup", 2: " ", 0: "background", 5: "cup (1)", 9: "x" * 300})
    assert list(labels.values()) == [0, 1, 2, 3, 5, 9]
    assert all(label and len(label) < 60 for label in labels) and len(set(labels)) == 6
    assert list(labels)[:2] == ["background", "cup (1)"]
