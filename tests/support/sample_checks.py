"""A tiny generated scene, what is in its folder, and whether its tracks are right."""

from __future__ import annotations

import json

import numpy as np
from PIL import Image

from beags_plugin.sample import FAMILIES
from beags_plugin.sample.points import Photo, find_tracks, seed_points
from beags_plugin.sample.tracing import first_hits
from beags_plugin.sample.views import render_view
from beags_plugin.sample.writer import SampleConfig

TINY = SampleConfig(seed=3, width=24, height=16, num_train=5, num_test=2, num_points=101, degradation="strong")


def grey(path):
    return np.array(Image.open(path))


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


def assert_tracks_agree(config: SampleConfig) -> None:
    """Check tracks by rays from every photo to every point: none meets anything before it, and none is of a visitor."""
    made = FAMILIES.get(config.family)
    views = [view for view in made.views(config.seed, 64, 48, 8, 1) if view.split == "train"]
    shots = config.shots(made, views)
    pictures = [render_view(shot.scene, shot.light, shot.view, 1) for shot in shots]
    photos = [Photo(shot.view, shot.scene) for shot in shots]
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
    if made.turns:  # a point of the standing room is elsewhere among the objects in every other photo
        assert found[~on_objects].sum(axis=1).tolist() == [1] * np.count_nonzero(~on_objects)
        found, expected = found[on_objects], expected[on_objects]
    assert np.array_equal(found, expected)
    assert 2.0 < found.sum(axis=1).mean() < len(shots)
