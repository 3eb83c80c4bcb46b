"""Photos of one scene that differ: exposure, white balance, a thing that moved, and which photos show a seed point."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image
from scene_distances import distance
from test_writer import TINY, grey

from beags_plugin.sample import FAMILIES, visitors
from beags_plugin.sample.exposure import photo_gains
from beags_plugin.sample.points import find_tracks, seed_points
from beags_plugin.sample.seen import Photo
from beags_plugin.sample.shots import AHEAD, plan_shots, taken
from beags_plugin.sample.tracing import first_hits
from beags_plugin.sample.views import pixel_directions, render_view
from beags_plugin.sample.writer import SampleConfig, write_sample
from beags_plugin.system.errors import UserError

TRAIN, TEST = [f"train{i}" for i in range(150)], [f"test{i}" for i in range(50)]
DESK = pytest.param("desk", marks=pytest.mark.slow("draws textures at many times the pixels of the photos"))


@pytest.fixture(scope="module", params=("tabletop", "turntable", "room", DESK))
def family(request):
    return request.param


@pytest.fixture(scope="module")
def folders(family, tmp_path_factory):
    """The same sample with photos that are alike, with exposures, and with a thing that moved."""
    root = tmp_path_factory.mktemp("shots")
    options = {"alike": {}, "exposed": {"exposure": 1.5, "white_balance": 0.5}, "moved": {"moved": 2}}
    return {
        name: write_sample(root / name, dataclasses.replace(TINY, width=48, height=32, family=family, **option))
        for name, option in options.items()
    }


def files(folder, *kinds):
    """Content of the files whose path begins with one of ``kinds`` (all files if there is none)."""
    paths = (p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    return {p: (folder / p).read_bytes() for p in paths if not kinds or p.startswith(kinds)}


def points_of(folder):
    body = (folder / "seed_points.ply").read_bytes().partition(b"end_header\n")[2]
    return np.frombuffer(body, dtype=[("p", "<f4", 3), ("c", "u1", 3)])


def splits(folder):
    meta = json.loads((folder / "transforms.json").read_text())
    return ([path[7:-4] for path in meta[f"{split}_filenames"]] for split in ("train", "test"))


@pytest.mark.parametrize("seed", range(4))
def test_gains_differ_by_the_stops_asked_for(seed):
    gains = photo_gains(TRAIN, TEST, seed, 1.5, 0.3)
    stops = np.log2(np.stack([gains[name] for name in TRAIN + TEST]))
    exposure, tint = stops[:, 1], stops[:, 0] - stops[:, 1]
    assert np.allclose(stops[:, 2] - exposure, -tint)  # blue turns as far as red, the other way
    for values, largest in ((exposure, 1.5), (tint, 0.3)):
        assert abs(values[:150].mean()) < 1e-12
        assert np.abs(values).max() <= largest * (1 + 1e-12)
        assert 0.8 < values[:150].std() / (largest / 3) < 1.2 and 0.6 < values[150:].std() / (largest / 3) < 1.4
    assert abs(np.corrcoef(exposure, tint)[0, 1]) < 0.3
    twice = photo_gains(TRAIN, TEST, seed, 3.0, 0.0)
    assert np.allclose(np.log2(np.stack([twice[name] for name in TRAIN + TEST])), 2 * exposure[:, None])
    assert photo_gains(TRAIN, TEST, seed + 1, 1.5, 0.3)["train0"][1] != gains["train0"][1]


def test_the_mean_is_kept_within_the_bound():
    for seed in range(200):  # single lots lie beyond it
        stops = np.log2([gain[1] for gain in photo_gains(TRAIN[:20], TEST[:5], seed, 1.0, 0.0).values()])
        assert abs(stops[:20].mean()) < 1e-12 and np.abs(stops).max() <= 1 + 1e-12
    assert photo_gains(["one"], [], 0, 6.0, 6.0)["one"].tolist() == [1.0, 1.0, 1.0]


def test_without_exposure_the_light_itself_is_taken():
    assert all((gain == 1.0).all() for gain in photo_gains(TRAIN, TEST, 0, 0.0, 0.0).values())
    family = FAMILIES.get("tabletop")
    for shot in plan_shots(family, 0, family.views(0, 16, 16, 3, 1), 0.0, 0.0, 0):
        assert shot.exposed is shot.light and shot.scene is shot.still


def test_a_photo_clips_what_its_gain_makes_too_bright(family):
    made = FAMILIES.get(family)
    views = made.views(0, 32, 24, 5, 1)
    burnt = []
    for shot in plan_shots(made, 0, views, 5.0, 0.5, 0):
        gains = photo_gains([v.name for v in views if v.split == "train"], [v.name for v in views if v.split == "test"],
                            0, 5.0, 0.5)[shot.view.name]  # fmt: skip
        rays = pixel_directions(shot.view)
        hits, _ = first_hits(shot.scene, shot.view.center, rays)
        linear = shot.light.colours(shot.view.center + hits.t[:, None] * rays, hits.surface, rays, shot.view.center)
        expected = np.floor(255.0 * np.minimum(gains * linear, 1.0) ** (1 / 2.2) + 0.5).reshape(24, 32, 3)
        assert np.array_equal(render_view(shot.scene, shot.exposed, shot.view, 1).image, expected)
        burnt.append(((expected == 255).mean(), (linear >= 1).mean(), gains.min()))
    assert max(now - before for now, before, _ in burnt) > 0.01
    assert all(now >= before for now, before, gain in burnt if gain >= 1)


def test_exposure_changes_the_photos_and_nothing_else(folders):
    alike, exposed = folders["alike"], folders["exposed"]
    before, now = files(alike), files(exposed)
    assert before.keys() == now.keys()
    changed = {path for path in before if before[path] != now[path]}
    photos = set(files(alike, "images", "ground_truth/removed/"))
    assert changed - {"sample.json"} <= photos
    assert changed >= set(files(alike, "images"))
    assert points_of(alike)["c"].std() > 5  # all bytes of the points are alike: their colours are of the mean exposure
    options = json.loads((exposed / "sample.json").read_text())
    assert (options["exposure"], options["white_balance"], options["moved"]) == (1.5, 0.5, 0)


def shown_stops(before, now):
    """Median log2 of the ratio of two sRGB pictures in linear light, per channel, where neither is dark or clipped."""
    before, now = ((pixels / 255.0) ** 2.2 for pixels in (before, now))
    clear = (before > 0.02) & (before < 0.95) & (now > 0.02) & (now < 0.95)
    return np.log2([np.median(now[..., c][clear[..., c]] / before[..., c][clear[..., c]]) for c in range(3)])


def test_photos_and_pictures_without_an_object_show_the_gains(folders):
    alike, exposed = folders["alike"], folders["exposed"]
    gains = photo_gains(*splits(alike), TINY.seed, 1.5, 0.5)
    for path in sorted((alike / "images").iterdir()):
        stops = shown_stops(grey(path), grey(exposed / "images" / path.name))
        assert np.allclose(stops, np.log2(gains[path.stem]), atol=0.05), path
    compared = 0
    for path in sorted((alike / "ground_truth/removed").rglob("*.png")):
        silhouette = grey(alike / "ground_truth/silhouettes" / path.parent.name / path.name) > 0
        pictures = [grey(folder / path.relative_to(alike))[silhouette] for folder in (alike, exposed)]
        if silhouette.sum() > 30 and (pictures[0].min(axis=1) > 60).sum() > 20:
            assert np.allclose(shown_stops(*pictures), np.log2(gains[path.stem]), atol=0.15), path
            compared += 1
    assert compared > 3


def test_a_visitor_stands_in_some_training_photos_and_is_background(folders):
    alike, moved = folders["alike"], folders["moved"]
    train, test = splits(alike)
    visited = []
    for stem in train:
        depth, now = (np.load(folder / f"ground_truth/depth/{stem}.npy") for folder in (alike, moved))
        nearer = now < depth
        assert np.array_equal(now[~nearer], depth[~nearer])
        labels, seen = (grey(folder / f"ground_truth/masks/{stem}.png") for folder in (alike, moved))
        assert (seen[nearer] == 0).all() and np.array_equal(seen[~nearer], labels[~nearer])
        if nearer.any():
            visited.append(stem)
            assert 0.01 < nearer.mean() < 0.3
            image, before = (Image.open(folder / f"images/{stem}.png") for folder in (moved, alike))
            assert (np.array(image) != np.array(before)).any(axis=-1)[nearer].mean() > 0.9
        else:
            assert (moved / f"images/{stem}.png").read_bytes() == (alike / f"images/{stem}.png").read_bytes()
    assert len(visited) == 2
    held_out = tuple(f"{kind}/{stem}.png" for kind in ("images", "masks", "ground_truth/masks") for stem in test)
    kinds = (*held_out, "ground_truth/silhouettes", "ground_truth/removed/")
    assert files(alike, *kinds) == files(moved, *kinds)


@pytest.mark.parametrize("seed", range(4))
def test_a_visitor_touches_no_object_and_no_camera(family, seed):
    made = FAMILIES.get(family)
    views = made.views(seed, 64, 48, 6, 1)
    places = []
    for shot in plan_shots(made, seed, views, 0.0, 0.0, 6):
        parts = shot.scene.fixtures[len(shot.still.fixtures) :]
        if shot.view.split == "test":
            assert not parts
            continue
        places.append(parts[0].position)
        cameras = np.stack([view.center for view in views])
        assert min(np.abs(distance(part, cameras)).min() for part in parts) > 0.05
        if family in ("room", "desk"):
            low = visitors.AROUND_ROOM[0] - 0.175  # its radius at the table's height
            for thing in (*shot.still.things, shot.still.fixtures[0]):
                vertices = thing.solid.vertices @ thing.rotation.T + thing.position
                assert np.hypot(vertices[:, 0], vertices[:, 1]).max() < low
            inside = shot.still.shell.half - np.abs(shot.still.shell.to_local(parts[0].position[None]))
            assert inside[0, :2].min() > 0.20
        else:
            points = np.random.default_rng(seed).uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 0.55], (4000, 3))
            points += parts[0].position
            body = np.min([part.solid.distance(part.to_local(points)) for part in parts], axis=0) < 0.0
            assert body.sum() > 100
            objects = np.min([distance(thing, points[body]) for thing in shot.still.things], axis=0)
            assert objects.min() > 0.0
    assert len({tuple(place.round(3)) for place in places}) == 6


def test_written_tracks_belong_to_the_points(folders):
    for folder in folders.values():
        tracks = json.loads((folder / "seed_tracks.json").read_text())
        assert tracks["photos"] == list(next(splits(folder)))
        assert len(tracks["points"]) == len(points_of(folder)) == TINY.num_points
        ends = [TINY.num_points * i // 5 for i in range(6)]
        for photo in range(5):
            for shown in tracks["points"][ends[photo] : ends[photo + 1]]:
                assert photo in shown and shown == sorted(set(shown)) and set(shown) <= set(range(5))


@pytest.mark.parametrize("moved", [0, 5])
def test_tracks_agree_with_exact_geometry(family, moved):
    """Against rays cast from every photo to every point, visitors included: nothing is met before the point."""
    made = FAMILIES.get(family)
    shots = [s for s in plan_shots(made, 0, made.views(0, 64, 48, 8, 1), 0.0, 0.0, moved) if s.view.split == "train"]
    pictures = [render_view(shot.scene, shot.light, shot.view, 1) for shot in shots]
    photos = [Photo(shot.view, shot.scene, picture.depth) for shot, picture in zip(shots, pictures, strict=True)]
    generator = np.random.default_rng(0)
    seeds = [
        seed_points(shot.view, picture, shot.lasting(picture), 60, 0.03, generator)
        for shot, picture in zip(shots, pictures, strict=True)
    ]
    places = np.concatenate([each.places for each in seeds])
    on_objects = np.concatenate([each.on_objects for each in seeds])
    tracks = find_tracks(seeds, photos, made.turns)
    found, expected = np.zeros((2, len(places), len(shots)), dtype=bool)
    for i, track in enumerate(tracks):
        found[i, track] = True
    for j, shot in enumerate(shots):
        view, rays = shot.view, places - shot.view.center
        local = rays @ view.camera_to_world[:3, :3]
        x, y = view.cx - view.focal * local[:, 0] / local[:, 2], view.cy + view.focal * local[:, 1] / local[:, 2]
        inside = (local[:, 2] < 0) & (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
        expected[:, j] = inside & (first_hits(shot.scene, view.center, rays)[0].t > 1 - 1e-6)
        own = first_hits(shot.still, view.center, rays[60 * j : 60 * (j + 1)])[0].t
        assert np.abs(own - 1).max() < 1e-5  # none is of a visitor
    if family == "turntable":  # a point of the standing room is elsewhere among the objects in every other photo
        assert found[~on_objects].sum(axis=1).tolist() == [1] * np.count_nonzero(~on_objects)
        found, expected = found[on_objects], expected[on_objects]
    assert np.array_equal(found, expected)
    assert 2.0 < found.sum(axis=1).mean() < len(shots)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"exposure": -0.1}, "exposure is -0.1: give .* in stops, from 0 to 6"),
        ({"exposure": 6.5}, "exposure is 6.5"),
        ({"exposure": float("nan")}, "exposure is nan"),
        ({"white_balance": -1.0}, "white_balance is -1.0"),
        ({"white_balance": float("inf")}, "white_balance is inf"),
        ({"moved": -1}, "moved is -1: give at least 0"),
        ({"moved": 61}, "moved is 61: give at most 60, the number of training photos"),
    ],
)
def test_differences_that_no_capture_has_are_refused(tmp_path, wrong, sentence):
    with pytest.raises(UserError, match=sentence):
        write_sample(tmp_path / "s", SampleConfig(**wrong))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("count", [1, AHEAD, AHEAD + 3])
def test_pictures_rendered_beside_each_other_are_those_of_one_after_another(count):
    made = FAMILIES.get("desk")
    shots = plan_shots(made, 0, made.views(0, 32, 24, count, 1)[:count], 0.0, 0.0, 0)
    pictures = list(taken(shots, 2))
    assert [shot for shot, _ in pictures] == shots
    for shot, picture in pictures:
        alone = render_view(shot.scene, shot.exposed, shot.view, 2)
        for name in ("image", "labels", "depth", "silhouettes"):
            assert np.array_equal(getattr(picture, name), getattr(alone, name))
