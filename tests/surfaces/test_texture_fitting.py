"""Textures fitted to photos: a box with a print that is finer than the mean of its photos shows."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

open3d = pytest.importorskip("open3d")
pytest.importorskip("xatlas")

from photographed_box import EXPOSURES, EYES, a_box, camera_from, photo_of
from scipy.sparse.linalg import lsmr
from threadpoolctl import threadpool_limits

from beags_plugin.core.cameras import Camera
from beags_plugin.surfaces.atlas import picture, texels, unwrapped
from beags_plugin.surfaces.baking import Places, baked
from beags_plugin.surfaces.fitting import fitted
from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.surfaces.item import Photo
from beags_plugin.surfaces.surface import area_vectors, vertex_normals
from beags_plugin.surfaces.texture import suitable_density, textured

FINE = 75.0  # radians a unit: about six pixels a period


def print_at(points: np.ndarray) -> np.ndarray:
    """Return light of each place, between 0.1 and 0.7."""
    return 0.4 + 0.3 * np.sin(FINE * points[:, [1, 2, 0]]) * np.sin(FINE * points[:, [2, 0, 1]] + 1.0)


@pytest.fixture(scope="module")
def box() -> Mesh:
    return a_box()


@pytest.fixture(scope="module")
def photos(box) -> list[Photo]:
    return [photo_of(box, camera_from(eye), light=print_at, rays=3) for eye in EYES]


def mean_picture(mesh: Mesh, photos: list[Photo]):
    """Return an atlas and the picture before it is fitted."""
    atlas = unwrapped(mesh, 4096, suitable_density(mesh, photos))
    at = texels(atlas)
    normals = at.of(vertex_normals(mesh))
    spacing = np.sqrt(np.linalg.norm(area_vectors(mesh), axis=1).sum() / len(at.rows))
    found = baked(Places(at.of(mesh.vertices), normals, spacing), mesh, photos, at.of(mesh.colors))
    return atlas, picture(atlas, at, found.colors)


def error(mesh: Mesh, atlas, image: np.ndarray, camera: Camera) -> float:
    """Return the root mean square difference to a photo that nobody was given, well inside its outline."""
    photo = photo_of(mesh, camera, light=print_at, rays=3)
    meshes = pytest.importorskip("beags_benchmarks.studies.meshes")
    drawn = meshes.Drawn(mesh.vertices[atlas.source], atlas.faces, None, atlas.uv, image / 255.0)
    shown, there = drawn.seen_by(camera, np.eye(4))
    inside = photo.own().numpy() & there
    inside &= np.roll(inside, 2, 0) & np.roll(inside, -2, 0) & np.roll(inside, 2, 1) & np.roll(inside, -2, 1)
    return float(np.sqrt(((shown - photo.image().numpy())[inside] ** 2).mean()))


def test_a_fitted_texture_is_nearer_to_photos_that_it_was_not_given(box, photos):
    atlas, mean = mean_picture(box, photos)
    sharp = fitted(mean, atlas, box, photos, np.ones((len(photos), 3)))
    other = camera_from((1.9, -0.4, 1.4))
    before, after = error(box, atlas, mean, other), error(box, atlas, sharp, other)
    assert before > 0.02 and after < 0.6 * before
    assert np.array_equal(sharp, fitted(mean, atlas, box, photos, np.ones((len(photos), 3))))


def test_textures_do_not_depend_on_the_number_of_threads(box, photos, monkeypatch):
    """The solver's numbers before rounding, which tell more, do not depend on it either."""
    atlas, mean = mean_picture(box, photos)
    found: dict[int, list[np.ndarray]] = {1: [], 2: []}
    for threads, kept in found.items():

        def solve(*arguments, kept=kept, **options):
            answer = lsmr(*arguments, **options)
            kept.append(answer[0])
            return answer

        monkeypatch.setattr("scipy.sparse.linalg.lsmr", solve)
        with threadpool_limits(threads, "blas"):
            kept.append(fitted(mean, atlas, box, photos, np.ones((len(photos), 3))))
    assert len(found[1]) == 4 and len(found[1][0]) > 20_000  # BLAS splits only sums of this many numbers.
    assert all(np.array_equal(one, two) for one, two in zip(found[1], found[2], strict=True))


def test_exposures_are_divided_out(box, photos):
    """The same texture comes of photos that are brighter and darker, once it is known by how much."""
    atlas, mean = mean_picture(box, photos)
    uneven = [
        photo_of(box, camera_from(eye), exposure, light=print_at, rays=3)
        for eye, exposure in zip(EYES, EXPOSURES, strict=True)
    ]
    even = fitted(mean, atlas, box, photos, np.ones((len(EYES), 3))).astype(int)
    found = fitted(mean, atlas, box, uneven, np.repeat(EXPOSURES[:, None], 3, axis=1)).astype(int)
    assert np.abs(found - even).mean() < 0.5
    wrong = fitted(mean, atlas, box, uneven, np.ones((len(EYES), 3))).astype(int)
    assert np.abs(wrong - even).mean() > max(1.0, 4.0 * np.abs(found - even).mean())


def test_what_no_photo_shows_and_what_stands_before_the_object_change_nothing(box, photos):
    atlas, mean = mean_picture(box, photos)
    grey = np.full_like(mean, 128)
    at = texels(atlas)
    below = at.of(box.vertices)[:, 2] < -0.39
    screened = [photo_of(box, camera_from(eye), light=print_at, rays=3, screen=True) for eye in EYES]
    found = fitted(grey, atlas, box, screened, np.ones((len(EYES), 3)))
    assert (found[at.rows[below], at.columns[below]] == 128).all()
    assert (found != 128).any(axis=2).mean() > 0.1
    red = (found[..., 0] > 215) & (found[..., 1] < 50) & (found[..., 2] < 50)
    assert not red.any()
    unseen = [replace(photo, own=lambda: torch.zeros(160, 160, dtype=torch.bool)) for photo in photos]
    assert fitted(mean, atlas, box, unseen, np.ones((len(EYES), 3))) is mean


def test_a_picture_is_as_large_as_its_density_takes(box, photos):
    density = suitable_density(box, photos)
    atlas = unwrapped(box, 4096, density)
    area = np.linalg.norm(area_vectors(box), axis=1).sum()
    assert 0.8**2 < len(texels(atlas).rows) / (density**2 * area) < 1.7**2
    assert atlas.size & (atlas.size - 1) == 0  # The validator of glTF demands a power of two.
    assert unwrapped(box, 128, 9 * density).size == 128  # no larger than it may be
    assert unwrapped(box, 4096, density / 100).size == 128
    texture = textured(box, photos, 0)
    assert texture.atlas.size == atlas.size and texture.image.shape == (atlas.size, atlas.size, 3)


def test_photos_that_look_away_do_not_coarsen_a_texture(box, photos):
    away = [camera_from(tuple(3.0 * np.array(eye))) for eye in EYES[1:]]
    turned = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    behind = [replace(photos[0], camera=replace(camera, viewmat=turned @ camera.viewmat)) for camera in away]
    assert suitable_density(box, [photos[0], *behind]) == pytest.approx(suitable_density(box, photos[:1]))
    assert suitable_density(box, behind) == 0.0
    assert textured(box, behind, 0).atlas.size == 128


def test_a_picture_of_more_pixels_than_can_be_fitted_stays_the_mean(box, photos, monkeypatch):
    """Some of them alone would sharpen texels here and there."""
    atlas, mean = mean_picture(box, photos)
    monkeypatch.setattr("beags_plugin.surfaces.fitting._MOST", 20_000)
    assert np.array_equal(fitted(mean, atlas, box, photos, np.ones((len(photos), 3))), mean)


def test_threads_that_start_while_a_texture_is_made_keep_theirs(box, photos, monkeypatch):
    """The viewer's for a new browser, say."""
    counts = {}

    def other():
        counts["other"] = torch.get_num_threads()

    def watched(*arguments):
        counts["own"] = torch.get_num_threads()
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        return fitted(*arguments)

    former = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        monkeypatch.setattr("beags_plugin.surfaces.texture.fitted", watched)
        textured(box, photos, 128)
        assert counts == {"own": 1, "other": 2} and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(former)


def test_textures_come_from_the_sharper_photos(box, photos):
    coarse = [photo_of(box, camera_from(eye, 40), light=print_at, rays=3) for eye in EYES]
    both = [replace(each, sharper=photo) for each, photo in zip(coarse, photos, strict=True)]
    other = camera_from((1.9, -0.4, 1.4))
    alone, sharp = (textured(box, given, 0) for given in (coarse, both))
    assert sharp.atlas.size > alone.atlas.size
    assert error(box, sharp.atlas, sharp.image, other) < 0.5 * error(box, alone.atlas, alone.image, other)
