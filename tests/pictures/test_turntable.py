"""Cameras around an object, pictures of it alone, and films that players read."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from start_scenes import a_frame, drawn

from beags_plugin.core.lifting import project
from beags_plugin.core.surfels import Surfels
from beags_plugin.pictures import video
from beags_plugin.pictures.objects import Subject, comparison, film, render_alone, sheet
from beags_plugin.pictures.options import RenderOptions
from beags_plugin.pictures.orbit import orbit, orbit_frame, orbit_settings
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.system.errors import UserError

LOW, HIGH = torch.tensor([-1.0, -2.0, 0.0]), torch.tensor([1.0, 2.0, 3.0])


def ball(color: float = 1.0, count: int = 200) -> Surfels:
    """Return discs all over the unit sphere, of one grey."""
    step = torch.arange(count) + 0.5
    z = 1 - 2 * step / count
    angle, radius = step * 2.399963, torch.sqrt(1 - z * z)
    means = torch.stack([radius * torch.cos(angle), radius * torch.sin(angle), z], dim=1)
    half = means + torch.tensor([0.0, 0.0, 1.0])  # its quaternion turns z to the mean
    quats = torch.stack([1 + z, -half[:, 1] + 0.0, half[:, 0], torch.zeros(count)], dim=1)
    dc = torch.full((count, 3), (color - 0.5) / 0.28209479177387814)
    return Surfels(means, quats, torch.full((count, 2), -2.0), torch.full((count,), 5.0), dc, torch.zeros(count, 0, 3))


# -- cameras -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("elevation", "turn"), [(20.0, 360.0), (0.0, 90.0), (-30.0, 360.0), (90.0, 360.0)])
def test_cameras_look_at_the_middle_and_the_box_fills_the_widest_picture(elevation, turn):
    stand = orbit_frame(LOW, HIGH)
    cameras = orbit(stand, 12, 100, elevation, turn)
    reach = []
    for camera in cameras:
        xy, z = project(torch.cat([stand.center[None], stand.corners]), camera)
        assert torch.allclose(xy[0], torch.full((2,), 50.0, dtype=torch.float64), atol=1e-3)
        assert float(z[0]) == pytest.approx(stand.distance, rel=1e-5)
        assert orbit_settings(stand).near < float(z.min()) and float(z.max()) < orbit_settings(stand).far
        reach.append(float((xy[1:] - 50).abs().max()) / 50)
        rotation = camera.rotation.double()
        assert torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-5)
        assert float(torch.linalg.det(rotation)) == pytest.approx(1.0, abs=1e-5)
        above = math.degrees(math.asin(float((camera.center.double() - stand.center) @ stand.up) / stand.distance))
        assert above == pytest.approx(elevation, abs=1e-2)
        if abs(elevation) < 90:  # the world's up is the picture's up
            (top,), _ = project((stand.center + 0.1 * stand.up)[None], camera)
            assert top[1] < 50 and float(top[0]) == pytest.approx(50.0, abs=1e-3)
    assert max(reach) == pytest.approx(1 / 1.06, rel=1e-3)


def test_a_turn_starts_at_the_front_goes_round_and_less_of_one_swings():
    stand = orbit_frame(LOW, HIGH)  # the front is -y

    def angles(turn: float) -> list[float]:
        centers = [camera.center.double() - stand.center for camera in orbit(stand, 8, 32, 0.0, turn)]
        return [math.degrees(math.atan2(float(c[0]), -float(c[1]))) % 360 for c in centers]

    assert angles(360.0) == pytest.approx([0, 45, 90, 135, 180, 225, 270, 315], abs=0.01)
    swing = [(angle + 180) % 360 - 180 for angle in angles(60.0)]
    assert max(swing) == pytest.approx(30, abs=0.01) and min(swing) == pytest.approx(-30, abs=0.01)
    assert swing[0] == pytest.approx(0, abs=0.01) == swing[4]


def test_up_and_front_are_those_of_the_photos():
    photos = orbit(orbit_frame(LOW, HIGH), 8, 32, 30.0, 80.0)
    stand = orbit_frame(LOW, HIGH, photos)
    tilted = torch.tensor([0.0, math.sin(math.radians(30)), math.cos(math.radians(30))], dtype=torch.float64)
    assert float(stand.up @ tilted) > 0.98
    assert float(torch.nn.functional.normalize(stand.front, dim=0)[1]) < -0.8
    transform, _ = a_frame(3)
    turn = transform[:, :3]
    moved = [
        type(c)(c.viewmat.double() @ torch.block_diag(turn.T, torch.eye(1)), c.K, c.width, c.height) for c in photos
    ]
    again = orbit_frame(LOW, HIGH, moved)
    assert torch.allclose(again.up, turn @ stand.up, atol=1e-6)


def test_an_empty_box_and_photos_from_straight_above_are_no_trouble():
    point = orbit_frame(torch.zeros(3), torch.zeros(3))
    above = replace(orbit_frame(LOW, HIGH), up=torch.tensor([0.0, -1.0, 0.0]).double())  # the front is up itself
    for stand in (point, above):
        assert all(bool(camera.viewmat.isfinite().all()) for camera in orbit(stand, 4, 32))


# -- pictures ----------------------------------------------------------------------------------------------------------


def test_what_is_not_covered_shows_the_background():
    stand = orbit_frame(-torch.ones(3), torch.ones(3))
    (camera,) = orbit(stand, 1, 64)
    settings, rasterizer = orbit_settings(stand), make_rasterizer("auto")
    white, black, checker = (
        render_alone(ball(0.4), camera, settings, rasterizer, name) for name in ("white", "black", "checker")
    )
    assert white[0, 0].tolist() == [255] * 3 and black[0, 0].tolist() == [0] * 3
    assert {tuple(pixel) for pixel in checker[0]} == {(200, 200, 200), (236, 236, 236)}
    assert (np.abs(white[32, 32].astype(int) - 102) < 8).all() and (white[32, 32] - black[32, 32].astype(int) < 8).all()
    expected = (255 * drawn(ball(0.4), camera, settings).clamp(0, 1)).round().to(torch.uint8).numpy()
    assert np.array_equal(black, expected)
    assert np.array_equal(
        render_alone(ball()[:0], camera, settings, rasterizer, "black"), np.zeros((64, 64, 3), np.uint8)
    )


def subjects(count: int, stages: tuple[str, ...]) -> list[Subject]:
    stand = orbit_frame(-torch.ones(3), torch.ones(3))
    cameras = orbit(stand, count, 33)
    return [
        Subject(name, {stage: ball(0.2 + 0.4 * i) for i, stage in enumerate(stages)}, cameras, orbit_settings(stand))
        for name in ("cup", "box")
    ]


def test_sheets_films_and_comparisons_hold_every_picture():
    rasterizer, counts = make_rasterizer("auto"), []
    picture = sheet(subjects(3, ("",)), rasterizer, "white", lambda *done: counts.append(done))
    assert picture.shape == (2 * (33 + 18 + 4), 3 * (33 + 4), 3) and counts == [(i, 6) for i in range(1, 7)]
    pair = comparison(subjects(2, ("before", "after")), rasterizer, "black")
    assert pair.shape == (2 * (33 + 18 + 4), 4 * (33 + 4), 3)  # objects beside each other
    before, after = pair[18:51, :33], pair[18:51, 37:70]
    assert abs(int(before[16, 16, 0]) - 51) < 8 and abs(int(after[16, 16, 0]) - 153) < 8
    frames = list(film(subjects(3, ("before", "after")), rasterizer, "white"))
    assert len(frames) == 3 and {frame.shape for frame in frames} == {(56, 4 * 37, 3)}


# -- films -------------------------------------------------------------------------------------------------------------


def test_a_film_is_read_back(tmp_path):
    av = pytest.importorskip("av")
    if video.encoder() is None:
        pytest.skip("no codec for .mp4")
    frames = [np.full((32, 48, 3), 20 * index, np.uint8) for index in range(6)]
    video.write_film(tmp_path / "new" / "a.mp4", frames, 10)
    with av.open(str(tmp_path / "new" / "a.mp4")) as container:
        stream = container.streams.video[0]
        read = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert stream.average_rate == 10
    assert [frame.shape for frame in read] == 6 * [(32, 48, 3)]
    assert all(abs(int(a[16, 24, 0]) - int(b[16, 24, 0])) < 8 for a, b in zip(read, frames, strict=True))
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.mp4"]


def test_a_gif_needs_no_codec(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "encoder", lambda: None)
    frames = [np.full((8, 8, 3), 80 * index, np.uint8) for index in range(3)]
    video.write_film(tmp_path / "a.gif", frames, 10)
    with Image.open(tmp_path / "a.gif") as picture:
        assert picture.n_frames == 3 and picture.info["duration"] == 100
    with pytest.raises(UserError, match="no codec for .mp4 is here: run pip install"):
        video.write_film(tmp_path / "a.mp4", frames, 10)
    with pytest.raises(UserError, match="is no .mp4 or .gif"):
        video.write_film(tmp_path / "a.webm", frames, 10)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"background": "pink"}, "there is no background 'pink': choose one of white, black, checker."),
        ({"frames": 0}, "frames is 0: give a number from 1 to 10000."),
        ({"fps": 1000}, "fps is 1000"),
        ({"size": 5}, "size is 5: give pixels from 16 to 4096."),
        ({"elevation": 100.0}, "elevation is 100.0"),
        ({"turn": math.nan}, "turn is nan"),
    ],
)
def test_options_are_checked(options, words):
    with pytest.raises(UserError) as error:
        RenderOptions(**options).check()
    assert words in str(error.value)
