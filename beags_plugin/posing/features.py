"""Features of photos in COLMAP's database, by OpenCV's SIFT: it takes a quarter of the time of COLMAP's on a CPU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.labels.classes import read_id_mask
from beags_plugin.posing.pairs import ALL
from beags_plugin.posing.photos import Look, Photo, look_at
from beags_plugin.system.reading.images import read_image
from beags_plugin.system.threads import worker_threads

MOST = 8192  # features per photo; a few photos far apart need that many
MOST_OF_MANY = 4096  # features of each of more than ``ALL`` photos: half the time, poses about as good (notes/poses.md)
LARGEST = 1200
"""Pixels of the longer side to which photos are reduced. The database holds points and lenses of reduced photos:
limits in pixels mean the same for photos of any size."""
WORKERS = 2  # photos at once; OpenCV uses little more than one core for a photo, and 0.5 GB for a large one
AHEAD = 8  # photos read before their features are written
GUESS = 1.2  # focal length, in longest sides, of a photo whose EXIF does not state it
LENS = "SIMPLE_RADIAL"
"""COLMAP's lens model while photos are added one by one; few parameters keep the solution stable."""


def add_features(database: Any, photos: Sequence[Photo], progress: Callable[[int, int], None]) -> list[Look]:
    """Add photos and their features to a database, except photos that it holds; returns the look of every photo."""
    import pycolmap

    most = MOST if len(photos) <= ALL else min(MOST, MOST_OF_MANY)
    known = {image.name: image.camera_id for image in database.read_all_images()}
    cameras = {_lens_of(photo): known[photo.key] for photo in photos if photo.key in known}
    looks = []
    for first in range(0, len(photos), AHEAD):
        some = photos[first : first + AHEAD]
        with worker_threads(WORKERS) as pool:
            seen = pool.map(partial(_seen, most=most), some, [photo.key not in known for photo in some])
            for photo, (look, features) in zip(some, seen, strict=True):
                looks.append(look)
                progress(len(looks), len(photos))
                if features is None:
                    continue
                with pycolmap.DatabaseTransaction(database):  # the database gets a photo together with its features
                    if _lens_of(photo) not in cameras:
                        cameras[_lens_of(photo)] = _write_camera(database, photo)
                    image_id = _write_image(database, photo.key, cameras[_lens_of(photo)])
                    database.write_keypoints(image_id, features[0])
                    database.write_descriptors(image_id, features[1])
    return looks


def _seen(photo: Photo, new: bool, most: int) -> tuple[Look, tuple[np.ndarray, Any] | None]:
    """Return the look of a photo and, if it is new, at most ``most`` features."""
    grey = np.asarray(read_image(photo.path, lambda image: image.convert("L"), "the photo", enough=LARGEST))
    if not new:
        return look_at(grey), None
    inside = None
    if photo.mask is not None:
        ids = read_id_mask(photo.mask, photo.ignore_ids)
        inside = np.uint8(255) * ((ids != BACKGROUND) & (ids != IGNORE))
    return look_at(grey), _features(grey, inside, reduced_size(photo), most)


def forget(database: Any, photos: Sequence[Photo]) -> None:
    """Rename photos that have changed in the database, so that their old features and matches are never used."""
    for photo in photos:
        if database.exists_image(photo.key):
            image = database.read_image_with_name(photo.key)
            image.name = f"{photo.key} before {database.num_images()}"
            database.update_image(image)


def reduced_size(photo: Photo) -> tuple[int, int]:
    """Return width and height of a photo that is reduced to ``LARGEST``."""
    factor = min(1.0, LARGEST / max(photo.width, photo.height))
    return max(1, round(photo.width * factor)), max(1, round(photo.height * factor))


def _lens_of(photo: Photo) -> tuple[int, int, float | None]:
    return photo.width, photo.height, photo.focal


def _features(grey: np.ndarray, inside: np.ndarray | None, size: tuple[int, int], most: int) -> tuple[np.ndarray, Any]:
    """Return points [N, 4] float32 (x, y, scale, direction; pixel centres at + 0.5) and COLMAP's RootSIFT [N, 128].

    N is ``most`` or less. inside: [H, W] uint8, 0 where no point may lie. size: width and height to which the photo is
    reduced first.
    """
    import cv2
    import pycolmap

    if grey.shape[::-1] != size:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    if inside is not None and inside.shape[::-1] != size:
        inside = cv2.resize(inside, size, interpolation=cv2.INTER_NEAREST)
    finder: Any = cv2.SIFT.create(nfeatures=most, contrastThreshold=0.02, enable_precise_upscale=True)
    keypoints, raw = finder.detectAndCompute(grey, inside)
    if raw is None:
        keypoints, raw = (), np.zeros((0, 128), np.float32)
    table = [(one.pt[0] + 0.5, one.pt[1] + 0.5, one.size / 2, np.deg2rad(one.angle)) for one in keypoints]
    points = np.array(table, np.float32).reshape(-1, 4)
    roots = np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-9))
    whole = np.minimum(np.round(512 * roots), 255).astype(np.uint8)
    return points, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, whole)


def _write_camera(database: Any, photo: Photo) -> int:
    import pycolmap

    width, height = reduced_size(photo)
    focal = GUESS * max(width, height) if photo.focal is None else photo.focal * (width / photo.width)
    camera = pycolmap.Camera.create_from_model_name(0, LENS, focal, width, height)
    camera.has_prior_focal_length = photo.focal is not None
    camera_id = database.write_camera(camera)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
    database.write_rig(rig)
    return camera_id


def _write_image(database: Any, name: str, camera_id: int) -> int:
    import pycolmap

    sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
    image_id = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
    frame = pycolmap.Frame()
    frame.rig_id = database.read_rig_with_sensor(sensor).rig_id
    frame.add_data_id(pycolmap.data_t(sensor, image_id))
    database.write_frame(frame)
    return image_id


def coarse_descriptors(database: Any, image_id: int, count: int) -> np.ndarray:
    """Return [count or fewer, 128] float32 of unit length: the descriptors of the largest features."""
    points = database.read_keypoints(image_id)
    scales = points[:, 2] if points.shape[1] == 4 else np.zeros(len(points))
    largest = np.argsort(-scales, kind="stable")[:count]
    rows = database.read_descriptors(image_id).data[largest].astype(np.float32)
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9)
