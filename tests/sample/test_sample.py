"""The sample scene: exact, consistent between its products and its views, decided by its seed."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from PIL import Image

from beags_plugin.core.cameras import viewmat_from_opengl
from beags_plugin.sample import writer
from beags_plugin.sample.arrangement import DOME_RADIUS, make_still
from beags_plugin.sample.degrade import (
    PRESETS,
    Degradation,
    degrade_mask,
    dropped_views,
    resolve_degradation,
    rim_amplitude,
    roughen_rims,
    swap_pieces,
)
from beags_plugin.sample.lighting import Light
from beags_plugin.sample.solids import Ball, Cone, Solid, Tube, slab
from beags_plugin.sample.views import make_views, render_view
from beags_plugin.sample.writer import SampleConfig, is_sample, write_sample
from beags_plugin.system.errors import UserError

WIDTH, HEIGHT = 96, 72
TINY = SampleConfig(seed=3, width=24, height=16, num_train=5, num_test=2, num_points=101, degradation="strong")


@pytest.fixture(scope="module")
def scene():
    """(still, views, pictures) of twelve views."""
    still = make_still(0)
    light = Light(still, object_samples=2, ground_samples=6)
    views = make_views(0, WIDTH, HEIGHT, 10, 2)
    return still, views, [render_view(still, light, view, 1) for view in views]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_sample(tmp_path_factory.mktemp("sample") / "tiny", TINY)


def grey(path):
    return np.array(Image.open(path))


SOLIDS = {
    "cone": Solid((Cone(0.5, 0.8), *slab(2, 0.0, 0.8)), bound=0.8),
    "ring": Solid((Tube(0.6), *slab(2, -0.2, 0.2)), (Tube(0.4),), 0.7),
    "bowl": Solid((Ball(0.7), *slab(2, -0.65, 0.1)), (Ball(0.6),), 0.7),
    "box": Solid((*slab(0, -0.3, 0.3), *slab(1, -0.4, 0.4), *slab(2, -0.5, 0.5)), bound=0.75),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_first_hits_match_marching(name):
    """Against fine steps along each ray through the inside test, which shares no code with the intersections."""
    solid = SOLIDS[name]
    generator = np.random.default_rng(1)
    origins = generator.normal(size=(60, 3))
    origins *= 2.0 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = generator.uniform(-0.5, 0.5, (60, 3)) - origins
    t = np.linspace(0.0, 2.0, 8001)
    points = origins[:, None] + t[:, None] * directions[:, None]
    inside = (solid.distance(points.reshape(-1, 3)) < 0.0).reshape(60, -1)
    found = solid.first_hit(origins, directions)
    assert 15 < inside.any(axis=1).sum() < 60
    clear = ~(np.isfinite(found) ^ inside.any(axis=1))
    assert clear.sum() >= 59  # a grazing ray may slip between the steps
    hit = inside.any(axis=1) & np.isfinite(found)
    close = np.abs(found[hit] - t[inside.argmax(axis=1)[hit]]) < 2.0 / 8000 + 1e-9
    assert close.sum() >= hit.sum() - 1
    assert np.abs(solid.distance((origins + found[:, None] * directions)[hit])).max() < 1e-9
    assert np.array_equal(solid.occludes(origins, directions), np.isfinite(found))


@pytest.mark.parametrize("name", SOLIDS)
def test_normals_are_outward_and_unit(name):
    solid = SOLIDS[name]
    directions = np.random.default_rng(2).uniform(-0.3, 0.3, (200, 3)) - np.array([[1.2, 0.9, 1.4]])
    origin = np.array([[1.2, 0.9, 1.4]])
    t = solid.first_hit(origin, directions)
    points = (origin + t[:, None] * directions)[np.isfinite(t)]
    normals = solid.normals(points)
    assert len(points) > 50
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert (solid.distance(points + 1e-6 * normals) > 0.0).all()
    assert (solid.distance(points - 1e-6 * normals) < 0.0).all()
    assert (np.einsum("ni,ni->n", normals, directions[np.isfinite(t)]) < 0.0).all()  # first hits face the eye


@pytest.mark.parametrize("seed", range(6))
def test_objects_touch_and_do_not_interpenetrate(seed):
    still = make_still(seed)
    touched = set()
    for contact in still.contacts:
        touched |= {contact.first, contact.second}
        for class_id in (contact.first, contact.second):
            if class_id == 0:
                assert abs(contact.point[2]) < 1e-9
            else:
                assert abs(still.things[class_id - 1].distance(contact.point[None])[0]) < 1e-9
    assert touched == set(range(len(still.things) + 1))
    generator = np.random.default_rng(seed)
    points = generator.uniform([-1.2, -1.2, -0.05], [1.2, 1.2, 1.1], (120_000, 3))  # smaller objects need more of them
    distances = np.stack([thing.distance(points) for thing in still.things])
    inside = distances < -1e-9
    assert (inside.sum(axis=1) > 20).all()
    assert inside.sum(axis=0).max() == 1
    assert points[inside.any(axis=0), 2].min() > 0.0


def lifted(view, picture):
    """[H, W, 3] world points from the depth, by the OpenCV camera of the core."""
    viewmat = viewmat_from_opengl(torch.from_numpy(view.camera_to_world)).numpy()
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    ray = np.stack([(x - view.cx) / view.focal, (y - view.cy) / view.focal, np.ones_like(x)], axis=-1)
    camera = ray * picture.depth[..., None]
    return (camera - viewmat[:3, 3]) @ viewmat[:3, :3]


def nearest_around(depth):
    """The least depth in each pixel's 3x3 neighbourhood."""
    padded = np.pad(depth, 1, mode="edge")
    return np.min([padded[i : i + HEIGHT, j : j + WIDTH] for i in range(3) for j in range(3)], axis=0)


def test_depth_lies_on_the_labelled_surface(scene):
    still, views, pictures = scene
    for view, picture in zip(views, pictures, strict=True):
        points = lifted(view, picture)
        for class_id, thing in enumerate(still.things, start=1):
            on_it = points[picture.labels == class_id]
            assert np.abs(thing.distance(on_it)).max(initial=0.0) < 1e-5
        rest = points[picture.labels == 0]
        assert np.minimum(np.abs(rest[:, 2]), np.abs(np.linalg.norm(rest, axis=1) - DOME_RADIUS)).max() < 1e-5


def test_views_agree_where_points_are_unoccluded(scene):
    _, views, pictures = scene
    compared = agreed = 0
    for source in (0, 4, 9):
        points = lifted(views[source], pictures[source]).reshape(-1, 3)
        labels = pictures[source].labels.ravel()
        for target in range(len(views)):
            viewmat = viewmat_from_opengl(torch.from_numpy(views[target].camera_to_world)).numpy()
            camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
            front = camera[:, 2] > 0.1
            xy = camera[front, :2] / camera[front, 2:] * views[target].focal + [views[target].cx, views[target].cy]
            column, row = np.floor(xy).astype(int).T
            seen = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
            z, found = camera[front][seen, 2], pictures[target].depth[row[seen], column[seen]]
            visible = np.abs(z - found) < 0.01 * z
            same = pictures[target].labels[row[seen], column[seen]] == labels[front][seen]
            compared += visible.sum()
            agreed += (same & visible).sum()
            # Nothing is seen through: a surface point lies at or behind what some pixel next to it shows.
            assert np.mean(z > nearest_around(pictures[target].depth)[row[seen], column[seen]] - 0.02 * z) > 0.999
    assert compared > 20_000
    assert agreed > 0.97 * compared  # the rest are pixels on a rim


def test_silhouettes_hold_the_visible_masks(scene):
    still, _, pictures = scene
    occluded = unoccluded = 0
    for picture in pictures:
        for class_id in range(1, len(still.things) + 1):
            visible, silhouette = picture.labels == class_id, picture.silhouettes[class_id - 1]
            assert not (visible & ~silhouette).any()
            covered = picture.labels[silhouette & ~visible]
            assert (covered > 0).all()  # only another object hides an object
            occluded += len(covered) > 0
            unoccluded += silhouette.any() and len(covered) == 0
        assert np.array_equal(picture.silhouettes.any(axis=0), picture.labels > 0)
    assert occluded > 20
    assert unoccluded > 5


@pytest.mark.parametrize("seed", range(4))
def test_every_object_is_seen_in_most_views(seed):
    still = make_still(seed)
    light = Light(still, 2, 6)
    pictures = [render_view(still, light, view, 1) for view in make_views(seed, 48, 36, 14, 1)]
    for class_id in range(1, len(still.things) + 1):
        assert sum((p.labels == class_id).sum() >= 4 for p in pictures) > 0.5 * len(pictures)


def test_images_are_exposed_and_textured(scene):
    _, _, pictures = scene
    for picture in pictures:
        assert picture.image.dtype == np.uint8 and picture.image.shape == (HEIGHT, WIDTH, 3)
        assert (picture.image == 255).all(axis=-1).mean() < 0.05
        assert picture.image.max(axis=-1).min() > 5
        for class_id in range(1, 8):
            pixels = picture.image[picture.labels == class_id]
            assert len(pixels) < 30 or pixels.std(axis=0).max() > 8.0


def test_antialiasing_is_the_mean_of_finer_rays(scene):
    still, _, _ = scene
    light = Light(still, 2, 6)
    (view, _) = make_views(0, 16, 16, 1, 1)
    image = render_view(still, light, view, 3).image.astype(float)
    fine = type(view)(view.name, "train", view.camera_to_world, 3 * view.focal, 3 * view.cx, 3 * view.cy, 48, 48)
    linear = (render_view(still, light, fine, 1).image / 255.0) ** 2.2
    expected = 255.0 * linear.reshape(16, 3, 16, 3, 3).mean(axis=(1, 3)) ** (1 / 2.2)
    assert np.abs(image - expected).max() < 2.0  # the finer image was rounded to 8 bits


def test_seeds_change_everything_and_repeat():
    a, b, again = make_still(1), make_still(2), make_still(1)
    for thing, other, same in zip(a.things, b.things, again.things, strict=True):
        assert np.array_equal(thing.position, same.position) and thing.solid == same.solid
        assert not np.allclose(thing.position, other.position)
        assert not np.allclose(thing.texture.light, other.texture.light)
    for first, second in zip(make_views(1, 32, 24, 4, 2), make_views(2, 32, 24, 4, 2), strict=True):
        assert not np.allclose(first.camera_to_world, second.camera_to_world)


@pytest.mark.parametrize(("train", "test"), [(60, 12), (5, 2), (1, 1), (3, 7)])
def test_views_are_split_and_rigid(train, test):
    views = make_views(0, 64, 48, train, test)
    assert [v.split for v in views].count("train") == train
    assert [v.split for v in views].count("test") == test
    names = [v.name for v in views]
    assert names == sorted(names)
    for view in views:
        rotation = view.camera_to_world[:3, :3]
        assert np.allclose(rotation @ rotation.T, np.eye(3)) and np.linalg.det(rotation) > 0.0
        assert 1.5 < np.linalg.norm(view.center) < 3.2 and view.center[2] > 0.3
        assert view.cx != 32 and view.cy != 24


# Degradation


@pytest.fixture(scope="module")
def labels(scene):
    return np.kron(scene[2][2].labels, np.ones((2, 2), np.uint8))


def test_rims_move_only_near_boundaries(labels):
    amplitude = 2.5
    found = roughen_rims(labels, amplitude, seed=0, view="a")
    changed = np.argwhere(found != labels)
    assert 0.005 < len(changed) / labels.size < 0.15
    reach = amplitude + np.sqrt(0.5)
    for row, column in changed:
        rows, columns = np.nonzero(labels == found[row, column])
        assert np.hypot(rows - row, columns - column).min() <= reach
    assert np.array_equal(roughen_rims(labels, 0.0, 0, "a"), labels)


def test_swaps_are_one_connected_piece_of_an_object(labels):
    from scipy import ndimage

    found, swaps = swap_pieces(labels, 8, 0.5, seed=4, view="b")
    assert swaps
    assert sum(s.pixels for s in swaps) == np.count_nonzero(found != labels)
    for swap in swaps:
        piece = (labels == swap.class_id) & (found != labels)
        assert ndimage.label(piece)[1] == 1 and piece.sum() == swap.pixels
        assert set(found[piece]) == {swap.new_id} and swap.new_id != swap.class_id
        assert 0 < swap.pixels <= 0.7 * np.count_nonzero(labels == swap.class_id)
    untouched = [i for i in range(1, 8) if i not in {s.class_id for s in swaps}]
    assert all((found[labels == i] == i).all() for i in untouched)
    assert (found[labels == 0] == 0).all()


def test_swaps_go_to_objects_and_to_the_background(labels):
    targets = [s.new_id for view in "abcdefgh" for s in swap_pieces(labels, 8, 1.0, 0, view)[1]]
    assert 0.25 < np.mean([t == 0 for t in targets]) < 0.75
    assert len(set(targets)) > 4


def test_dropped_views():
    names = [f"v{i}" for i in range(40)]
    dropped = dropped_views(names, 0, 0.2)
    assert len(dropped) == 8 and dropped < set(names)
    assert dropped == dropped_views(names[::-1], 0, 0.2) != dropped_views(names, 1, 0.2)
    assert len(dropped_views(names, 0, 1.0)) == 39  # one mask at least is left
    assert dropped_views(names, 0, 0.0) == set()


def test_degradation_depends_on_seed_and_view_alone(labels):
    strong = PRESETS["strong"]
    first = degrade_mask(labels, 8, strong, 0, "a")
    assert np.array_equal(first, degrade_mask(labels, 8, strong, 0, "a"))
    assert not np.array_equal(first, degrade_mask(labels, 8, strong, 0, "b"))
    assert not np.array_equal(first, degrade_mask(labels, 8, strong, 1, "a"))
    assert np.array_equal(labels, degrade_mask(labels, 8, PRESETS["none"], 0, "a"))
    assert first.dtype == labels.dtype


def test_presets_grow(labels):
    wrong = {n: np.mean([degrade_mask(labels, 8, p, 0, v) != labels for v in "abcdef"]) for n, p in PRESETS.items()}
    assert wrong["none"] == 0.0 < wrong["mild"] < wrong["strong"] < 0.2
    assert rim_amplitude(0.0075, 240, 320) == pytest.approx(3.0)
    with pytest.raises(UserError, match="mild"):
        resolve_degradation("wild")
    with pytest.raises(UserError, match="swapped"):
        resolve_degradation(Degradation(swapped=1.5))


# Files


def test_folder_layout(folder):
    meta = json.loads((folder / "transforms.json").read_text())
    frames = [f["file_path"] for f in meta["frames"]]
    assert frames == sorted(frames) and len(frames) == 7
    assert sorted(meta["train_filenames"] + meta["test_filenames"]) == frames
    assert len(meta["train_filenames"]) == 5 and meta["val_filenames"] == meta["test_filenames"]
    assert (meta["w"], meta["h"]) == (24, 16) and meta["fl_x"] == meta["fl_y"] > 0
    assert all(np.array(f["transform_matrix"]).shape == (4, 4) for f in meta["frames"])
    classes = json.loads((folder / "classes.json").read_text())
    assert classes["0"] == "background" and len(classes) == 8
    for path in frames:
        stem = path.split("/")[1][:-4]
        truth = grey(folder / "ground_truth/masks" / f"{stem}.png")
        assert Image.open(folder / path).size == (24, 16) and Image.open(folder / path).mode == "RGB"
        assert truth.shape == (16, 24) and truth.max() < 8
        depth = np.load(folder / "ground_truth/depth" / f"{stem}.npy")
        assert depth.dtype == np.float32 and depth.shape == (16, 24)
        for class_id, name in classes.items():
            if class_id != "0":
                silhouette = grey(folder / "ground_truth/silhouettes" / name / f"{stem}.png")
                assert set(np.unique(silhouette)) <= {0, 255}
                assert (silhouette[truth == int(class_id)] == 255).all()
        if path in meta["test_filenames"]:
            assert np.array_equal(grey(folder / "masks" / f"{stem}.png"), truth)
    assert len(list((folder / "masks").iterdir())) == 6  # a fifth of five views is dropped


def test_class_maps_are_readable_by_the_mask_module(folder):
    classes = pytest.importorskip("beags_plugin.labels.classes")
    for path in (folder / "masks").iterdir():
        assert np.array_equal(classes.read_id_mask(path), grey(path))
    assert len(classes.read_classes(folder / "classes.json")) == 8


def test_seed_points_lie_on_surfaces(folder):
    raw = (folder / "seed_points.ply").read_bytes()
    header, _, body = raw.partition(b"end_header\n")
    assert b"element vertex 101\n" in header
    records = np.frombuffer(body, dtype=[("p", "<f4", 3), ("c", "u1", 3)])
    assert len(records) == 101
    still = make_still(TINY.seed)
    points = records["p"].astype(float)
    near = [np.abs(points[:, 2]), np.abs(np.linalg.norm(points, axis=1) - DOME_RADIUS)]
    near += [np.abs(thing.distance(points)) for thing in still.things]
    assert np.min(near, axis=0).max() < 6 * writer.POINT_NOISE
    assert 0.3 < np.mean(np.min(near[2:], axis=0) < 6 * writer.POINT_NOISE) <= 1.0
    assert records["c"].std() > 5


def test_nerfstudio_reads_it(folder):
    pytest.importorskip("nerfstudio")
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    parser = NerfstudioDataParserConfig(data=folder, load_3D_points=False).setup()
    assert len(parser.get_dataparser_outputs("train").image_filenames) == 5
    assert len(parser.get_dataparser_outputs("val").image_filenames) == 2
    assert len(parser.get_dataparser_outputs("test").cameras) == 2


def test_same_config_gives_the_same_bytes_and_is_not_rebuilt(folder, tmp_path, monkeypatch):
    calls = []
    other = write_sample(tmp_path / "again", TINY, progress=lambda done, total: calls.append((done, total)))
    assert calls == [(i, 7) for i in range(1, 8)]
    files = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(other) for p in other.rglob("*") if p.is_file())
    assert all((folder / f).read_bytes() == (other / f).read_bytes() for f in files)
    monkeypatch.setattr(writer, "_build", lambda *_: pytest.fail("rebuilt"))
    assert write_sample(other, TINY) == other


def test_another_config_replaces_a_sample(tmp_path):
    small = {"width": 16, "height": 16, "num_train": 1, "num_test": 1, "num_points": 5, "antialias": 1}
    first, second = SampleConfig(seed=0, **small), SampleConfig(seed=1, **small)
    write_sample(tmp_path / "s", first)
    write_sample(tmp_path / "s", second)
    assert is_sample(tmp_path / "s", second) and not is_sample(tmp_path / "s", first)
    assert [p.name for p in tmp_path.iterdir()] == ["s"]


def test_an_interrupted_run_leaves_nothing_that_looks_complete(tmp_path):
    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_sample(tmp_path / "s", TINY, progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_a_foreign_folder_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(UserError, match="no sample scene"):
        write_sample(tmp_path, TINY)
    assert (tmp_path / "thesis.txt").read_text() == "mine"


@pytest.mark.parametrize("wrong", [{"width": 2}, {"num_test": 0}, {"seed": -1}, {"degradation": "wild"}])
def test_bad_configs_are_refused(tmp_path, wrong):
    with pytest.raises(UserError):
        write_sample(tmp_path / "s", SampleConfig(**wrong))
    assert list(tmp_path.iterdir()) == []
