"""Where exported objects stand and how large they are: texts, planes, and frames of files."""

from __future__ import annotations

import math

import pytest
import torch
from random_surfels import a_rotation

from beags_plugin.export.pose_options import KnownLength, PhotoPoint, PoseOptions, scale_by_text
from beags_plugin.surfaces.frames import Frame
from beags_plugin.surfaces.ground_plane import standing_plane, turn_to_z
from beags_plugin.system.errors import UserError


def test_lengths_are_read():
    found = PoseOptions(scale_by="frame_0012:340,215  frame 13.jpg:512.5,220 12 cm").length()
    assert found == KnownLength(PhotoPoint("frame_0012", 340, 215), PhotoPoint("frame 13.jpg", 512.5, 220), 0.12)
    found = PoseOptions(scale_by="0,0,0 1,-2e1,.5 3.5in").length()
    assert found is not None and found.first == (0, 0, 0) and found.second == (1, -20, 0.5)
    assert found.metres == pytest.approx(3.5 * 0.0254)
    assert PoseOptions().length() is None and PoseOptions(up="0, 0,-1").direction() == (0, 0, -1)
    assert PoseOptions(up="plane").direction() is None


@pytest.mark.parametrize("origin", [0.0, 512_345.678])
@pytest.mark.parametrize("size", [0.003, 1.0, 40.0])
def test_the_text_of_two_places_is_read_as_they_are(origin, size):
    first, second = (origin, -1e-9 * size, 0.2), (origin + 0.6 * size, 0.8 * size, 0.2)
    text = scale_by_text(first, second, " 12cm ")
    assert "-0.0" not in text and text.endswith(" 12 cm")
    found = PoseOptions(scale_by=text).length()
    assert found is not None and found.metres == pytest.approx(0.12)
    assert math.dist(found.first, found.second) == pytest.approx(size, rel=2e-4)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"scale_by": "12 cm"}, "scale_by is '12 cm': give two points, a length and its unit"),
        ({"scale_by": "a:1,2 b:3,4 12"}, "give two points, a length and its unit"),
        ({"scale_by": "a:1,2 b:3,4 12 yards"}, "give two points, a length and its unit"),
        ({"scale_by": "a:1,2 b:3,4 -12 cm"}, "the length must be above 0"),
        ({"up": "floor"}, "up is 'floor': give plane, or a direction such as 0,0,1"),
        ({"up": "0,0,0"}, "up is '0,0,0': give plane"),
        ({"up": "0,0,nan"}, "give plane"),
    ],
)
def test_wrong_texts(options, sentence):
    with pytest.raises(UserError, match=sentence):
        PoseOptions(**options)


def standing(tilt: torch.Tensor, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """A block of 0.4 x 0.3 x 0.2 on a table, beside another one, before a wall; turned by ``tilt``."""
    generator = torch.Generator().manual_seed(seed)

    def some(count: int, low: list[float], high: list[float]) -> torch.Tensor:
        share = torch.rand(count, 3, generator=generator, dtype=torch.float64)
        return torch.tensor(low) + share * (torch.tensor(high) - torch.tensor(low))

    table = some(3000, [-1, -1, 0.0], [1, 1, 0.0])
    table = table[(table[:, 0].abs() > 0.2) | (table[:, 1].abs() > 0.15)]  # The object hides what it stands on.
    wall, other = some(3000, [-1, 0.4, 0.0], [1, 0.4, 1.0]), some(500, [0.25, -0.1, 0.0], [0.45, 0.1, 0.15])
    around = torch.cat([table, wall, other]) + 0.001 * torch.randn(1, 3, generator=generator, dtype=torch.float64)
    own = some(2000, [-0.2, -0.15, 0.0], [0.2, 0.15, 0.2])
    own = own[(own[:, 0].abs() > 0.19) | (own[:, 1].abs() > 0.14) | (own[:, 2] > 0.19)]
    return around @ tilt.T + 3.0, own @ tilt.T + 3.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("off", [0.0, 35.0])
def test_the_plane_under_an_object(seed, off):
    tilt = a_rotation(seed)
    around, own = standing(tilt, seed)
    angle = math.radians(off)
    guess = tilt @ torch.tensor([0.0, math.sin(angle), math.cos(angle)], dtype=torch.float64)
    plane = standing_plane(around, own, guess)
    assert plane is not None
    truth = tilt[:, 2]
    assert math.degrees(math.acos(min(1.0, float(plane.normal @ truth)))) < 1.0
    assert plane.offset == pytest.approx(
        float(plane.normal @ (tilt @ torch.zeros(3, dtype=torch.float64) + 3.0)), abs=0.01
    )


def test_no_plane_is_found_where_none_is():
    around, own = standing(torch.eye(3, dtype=torch.float64))
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert standing_plane(around[:10], own, up) is None
    assert standing_plane(around, own[:2], up) is None
    floating = own + torch.tensor([0.0, 0.0, 0.15], dtype=torch.float64)
    assert standing_plane(around[around[:, 1] < 3.35], floating, up) is None


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -1), (1, 2, -3), (0, -1e-3, 0)])
def test_a_direction_turns_to_z(up):
    turn = turn_to_z(torch.tensor(up))
    assert torch.allclose(turn @ turn.T, torch.eye(3, dtype=torch.float64), atol=1e-12)
    assert float(torch.linalg.det(turn)) == pytest.approx(1.0)
    direction = torch.tensor(up, dtype=torch.float64)
    assert torch.allclose(
        turn @ direction / direction.norm(), torch.tensor([0, 0, 1.0], dtype=torch.float64), atol=1e-12
    )


def test_frames_turn_scale_and_shift_points_and_lead_back():
    shift = torch.tensor([[0.3], [0.1], [-0.2]], dtype=torch.float64)
    world = Frame(torch.cat([a_rotation(4), shift], dim=1), 0.4)
    turn, center = a_rotation(7), torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    points = torch.randn(5, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    frame = world.scaled(2.5).turned(turn).centred(center)
    expected = 2.5 * world.points(points) @ turn.T - center
    assert torch.allclose(frame.points(points), expected)
    assert torch.allclose(frame.in_run(expected), points)
    matrix = torch.tensor(frame.to_run(), dtype=torch.float64)
    assert torch.allclose(expected @ matrix[:3, :3].T + matrix[:3, 3], points)
