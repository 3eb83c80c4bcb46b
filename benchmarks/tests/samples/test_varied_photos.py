"""Photos of one scene that differ: exposure, white balance, a thing that moved, and which photos show a seed point."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image
from sample_checks import TINY, assert_tracks_agree, files, grey, points_of, splits
from scene_distances import distance

from beags_benchmarks.samples import visitors
from beags_benchmarks.samples.config import VariedSample
from beags_benchmarks.samples.exposure import photo_gains
from beags_plugin.commands import cli
from beags_plugin.sample import FAMILIES
from beags_plugin.sample.tracing import first_hits
from beags_plugin.sample.views import pixel_directions, render_view
from beags_plugin.sample.writer import SampleConfig, is_sample, write_sample
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
        name: write_sample(
            root / name, VariedSample(**{**vars(TINY), "width": 48, "height": 32, "family": family, **option})
        )
        for name, option in options.items()
    }


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
    for shot in VariedSample().shots(family, family.views(0, 16, 16, 3, 1)):
        assert shot.exposed is shot.light and shot.scene is shot.still


def test_without_its_options_it_is_the_sample_of_the_product():
    assert json.dumps(VariedSample().as_dict()) == json.dumps(SampleConfig().as_dict())


def test_the_command_takes_them(tmp_path):
    size = ["--width", "16", "--height", "16", "--views", "2"]
    own = ["--exposure", "1.5", "--white-balance", "0.5", "--moved", "1", "--shared-damage", "0.6"]
    cli.main(["bench", "sample", "--output", str(tmp_path / "s"), *size, *own, "--degradation", "1.5"])
    config = VariedSample(0, 16, 16, 2, 12, "1.5", exposure=1.5, white_balance=0.5, moved=1, shared_damage=0.6)
    assert is_sample(tmp_path / "s", config)


def test_a_photo_clips_what_its_gain_makes_too_bright(family):
    made = FAMILIES.get(family)
    views = made.views(0, 32, 24, 5, 1)
    burnt = []
    for shot in VariedSample(exposure=5.0, white_balance=0.5).shots(made, views):
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
    assert changed - {"sample.json"} == set(files(alike, "images"))
    assert points_of(alike)["c"].std() > 5  # all bytes of the points are alike: their colours are of the mean exposure
    options = json.loads((exposed / "sample.json").read_text())
    assert (options["exposure"], options["white_balance"], options["moved"]) == (1.5, 0.5, 0)


def shown_stops(before, now):
    """Median log2 of the ratio of two sRGB pictures in linear light, per channel, where neither is dark or clipped."""
    before, now = ((pixels / 255.0) ** 2.2 for pixels in (before, now))
    clear = (before > 0.02) & (before < 0.95) & (now > 0.02) & (now < 0.95)
    return np.log2([np.median(now[..., c][clear[..., c]] / before[..., c][clear[..., c]]) for c in range(3)])


def test_photos_show_the_gains(folders):
    alike, exposed = folders["alike"], folders["exposed"]
    gains = photo_gains(*splits(alike), TINY.seed, 1.5, 0.5)
    for path in sorted((alike / "images").iterdir()):
        stops = shown_stops(grey(path), grey(exposed / "images" / path.name))
        assert np.allclose(stops, np.log2(gains[path.stem]), atol=0.05), path


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
    kinds = (*held_out, "ground_truth/silhouettes")
    assert files(alike, *kinds) == files(moved, *kinds)


@pytest.mark.parametrize("seed", range(2))
def test_a_visitor_touches_no_object_and_no_camera(family, seed):
    made = FAMILIES.get(family)
    views = made.views(seed, 64, 48, 6, 1)
    places = []
    for shot in VariedSample(seed, moved=6, num_train=6).shots(made, views):
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


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"exposure": -0.1}, "exposure is -0.1: give .* in stops, from 0 to 6"),
        ({"exposure": 6.5}, "exposure is 6.5"),
        ({"exposure": float("nan")}, "exposure is nan"),
        ({"white_balance": -1.0}, "white_balance is -1.0"),
        ({"white_balance": float("inf")}, "white_balance is inf"),
        ({"moved": -1}, "moved is -1: give from 0 to 60, the number of training photos"),
        ({"moved": 61}, "moved is 61: give from 0 to 60"),
    ],
)
def test_differences_that_no_capture_has_are_refused(tmp_path, wrong, sentence):
    with pytest.raises(UserError, match=sentence):
        write_sample(tmp_path / "s", VariedSample(**wrong))
    assert list(tmp_path.iterdir()) == []


def test_tracks_agree_with_exact_geometry(family):
    assert_tracks_agree(VariedSample(family=family, moved=5))
