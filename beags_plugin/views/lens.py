"""Lens distortion: removed from images of any size as nerfstudio does, restored, and applied to points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.views.cameras import FISHEYE, camera_from_nerfstudio

if TYPE_CHECKING:
    from beags_plugin.views.cameras import AnyCameras

_MARGIN = 0.5  # space beyond each side, in images; farther out, a lens model may fold back into the image


def has_lens(cameras: AnyCameras, index: int) -> bool:
    """Return whether a view has lens distortion."""
    return cameras.distortion_params is not None and bool(cameras.distortion_params[index].any())


def undistort_image(image: np.ndarray, distorted: AnyCameras, index: int) -> np.ndarray:
    """Remove the lens distortion of a view from its image [H, W, C] and crop it, as nerfstudio does."""
    K, lens, new_K, (x, y, width, height) = _straightened(distorted, index, (image.shape[1], image.shape[0]))
    if int(distorted.camera_type[index]) == FISHEYE:
        maps = cv2.fisheye.initUndistortRectifyMap(
            K, lens, np.eye(3), new_K, (image.shape[1], image.shape[0]), cv2.CV_32FC1
        )
        return cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR)
    return cv2.undistort(image, K, lens, None, new_K)[y : y + height, x : x + width]


def straighten(cameras: AnyCameras) -> None:
    """Set K and size of cameras in place to those of their undistorted images; no image is read."""
    known: dict[tuple, tuple] = {}  # most scenes have one camera for all views
    for index in range(len(cameras)):
        if not has_lens(cameras, index):
            continue
        parts = (cameras.fx, cameras.fy, cameras.cx, cameras.cy, cameras.width, cameras.height, cameras.camera_type)
        key = (*(float(part[index]) for part in parts), *cameras.distortion_params[index].tolist())
        if key not in known:
            size = int(cameras.width[index]), int(cameras.height[index])
            _, _, K, (x, y, width, height) = _straightened(cameras, index, size)
            K[0, 2], K[1, 2] = K[0, 2] - x + 0.5, K[1, 2] - y + 0.5
            known[key] = (K, (width, height))
        K, (width, height) = known[key]
        cameras.fx[index], cameras.fy[index] = float(K[0, 0]), float(K[1, 1])
        cameras.cx[index], cameras.cy[index] = float(K[0, 2]), float(K[1, 2])
        cameras.width[index], cameras.height[index] = width, height


def undistort_labels(labels: np.ndarray, distorted: AnyCameras, straight: AnyCameras, index: int) -> np.ndarray:
    """Remove the lens distortion from labels; each pixel takes the nearest id.

    labels: [h, w], the whole distorted image at any size. distorted, straight: the cameras before and after
    ``straighten``. Returns [h', w'], the whole straight image at the same scale; IGNORE outside the lens.
    """
    maps = _lens_maps(distorted, straight, index, labels.shape)
    return labels if maps is None else _nearest(labels, *maps, IGNORE)


def undistort_alpha(alpha: np.ndarray, distorted: AnyCameras, straight: AnyCameras, index: int) -> np.ndarray:
    """Remove the lens distortion from an alpha channel [h, w] uint8, interpolated; 0 outside the lens."""
    maps = _lens_maps(distorted, straight, index, alpha.shape)
    return alpha if maps is None else cv2.remap(alpha, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def straight_size(distorted: AnyCameras, straight: AnyCameras, index: int, shape: tuple[int, ...]) -> tuple[int, int]:
    """Return width and height of the straight image at the scale where the distorted one has ``shape`` (h, w)."""
    height, width = shape
    return (
        max(1, round(int(straight.width[index]) * width / int(distorted.width[index]))),
        max(1, round(int(straight.height[index]) * height / int(distorted.height[index]))),
    )


def undistort_region(
    image: np.ndarray, distorted: AnyCameras, straight: AnyCameras, index: int, box: tuple[int, int, int, int],
    interpolation: int, border: int,
) -> np.ndarray:  # fmt: skip
    """Return a region of a straight image; memory grows with the region only.

    image: [h, w] or [h, w, C], the whole distorted image at any size. box: left, top, right and bottom in the straight
    image at the same scale. border: value outside the lens.
    """
    left, top, right, bottom = box
    if not has_lens(distorted, index):
        return np.ascontiguousarray(image[top:bottom, left:right])
    maps = _maps_of_region(distorted, straight, index, image.shape[:2], box)
    borders = (border,) * (image.shape[2] if image.ndim == 3 else 1)
    return cv2.remap(image, *maps, interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=borders)


def redistort_labels(
    labels: np.ndarray,
    distorted: AnyCameras,
    straight: AnyCameras,
    index: int,
    shape: tuple[int, int],
    border: int,
) -> np.ndarray:
    """Restore the lens distortion of labels: the inverse of ``undistort_labels``.

    labels: [h', w'], the whole straight image. shape: (h, w) of the distorted image at the same scale. border: value
    outside the straight image. Returns [h, w].
    """
    if not has_lens(distorted, index):
        return labels
    height, width = shape
    K = _intrinsics(distorted, index, width, height)
    new_K = _intrinsics(straight, index, labels.shape[1], labels.shape[0])
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    pixels = _straight(np.stack([columns, rows], axis=2).reshape(-1, 2), distorted, index, K, new_K)
    maps = pixels.reshape(height, width, 2).astype(np.float32)
    return _nearest(labels, maps[..., 0], maps[..., 1], border)


def project_through_lens(points: np.ndarray, cameras: AnyCameras, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels [P, 2] (centres at + 0.5) and depths [P] of world points [P, 3] float64 in a distorted view.

    cameras: before ``straighten``. A point far outside the image has the depth 0.
    """
    camera = camera_from_nerfstudio(cameras, index)
    rotation, translation = (part.double().numpy() for part in (camera.rotation, camera.translation))
    K = camera.K.double().numpy()
    local = points @ rotation.T + translation
    z = local[:, 2].copy()
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = (local @ K.T)[:, :2] / z[:, None]
        outside = np.abs(xy / [camera.width, camera.height] - 0.5).max(1) > 0.5 + _MARGIN
    if not has_lens(cameras, index):
        return xy, z
    z[(z <= 0) | outside] = 0.0
    near = np.flatnonzero(z > 0)
    if len(near):
        fisheye, lens = _opencv_lens(cameras, index)
        project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
        xy[near] = project(np.ascontiguousarray(local[near, None]), np.zeros(3), np.zeros(3), K, lens)[0][:, 0]
    return xy, z


def _straightened(
    distorted: AnyCameras, index: int, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[int, int, int, int]]:
    """Return how nerfstudio's ``_undistort_image`` removes the lens from an image of width and height ``size``.

    Returns K [3, 3], the lens's coefficients, the new K [3, 3], and left, top, width and height of the crop of the new
    image, for OpenCV, whose pixel centres are whole numbers. All have nerfstudio's precision, so that bits agree.
    """
    k1, k2, k3, k4, p1, p2 = distorted.distortion_params[index].numpy()
    K = camera_from_nerfstudio(distorted, index).K.numpy()
    K[0, 2], K[1, 2] = K[0, 2] - 0.5, K[1, 2] - 0.5
    if int(distorted.camera_type[index]) == FISHEYE:
        lens = np.array([k1, k2, k3, k4])
        new_K = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(K, lens, size, np.eye(3), balance=0)
        return K, lens, new_K, (0, 0, *size)
    lens = np.array([k1, k2, p1, p2, k3, k4, 0, 0])
    new_K, (x, y, width, height) = cv2.getOptimalNewCameraMatrix(K, lens, size, 0)
    return K, lens, new_K, (x, y, width, height)


def _lens_maps(
    distorted: AnyCameras, straight: AnyCameras, index: int, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return x and y [h', w'] float32 of the straight pixels in the distorted image of ``shape``, or None.

    None without distortion. shape: (h, w).
    """
    if not has_lens(distorted, index):
        return None
    new_size = straight_size(distorted, straight, index, shape)
    return _maps_of_region(distorted, straight, index, shape, (0, 0, *new_size))


def _maps_of_region(
    distorted: AnyCameras,
    straight: AnyCameras,
    index: int,
    shape: tuple[int, ...],
    box: tuple[int, int, int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``_lens_maps`` within left, top, right and bottom of the straight image at the scale of ``shape``."""
    height, width = shape
    left, top, right, bottom = box
    new_size = straight_size(distorted, straight, index, shape)
    K, new_K = _intrinsics(distorted, index, width, height), _intrinsics(straight, index, *new_size)
    new_K[:2, 2] -= (left, top)
    fisheye, lens = _opencv_lens(distorted, index)
    make = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    return make(K, lens, np.eye(3), new_K, (right - left, bottom - top), cv2.CV_32FC1)


def _opencv_lens(cameras: AnyCameras, index: int) -> tuple[bool, np.ndarray]:
    """Return whether a view has a fisheye lens, and its coefficients in OpenCV's order, float64."""
    k1, k2, k3, k4, p1, p2 = cameras.distortion_params[index].double().numpy()
    fisheye = int(cameras.camera_type[index]) == FISHEYE
    return fisheye, np.array([k1, k2, k3, k4] if fisheye else [k1, k2, p1, p2, k3])


def _intrinsics(cameras: AnyCameras, index: int, width: int, height: int) -> np.ndarray:
    """Return K [3, 3] float64 of the view's image at this size, for OpenCV, whose pixel centres are whole numbers."""
    K = camera_from_nerfstudio(cameras, index).K.double().numpy()
    K = np.diag([width / int(cameras.width[index]), height / int(cameras.height[index]), 1.0]) @ K
    K[:2, 2] -= 0.5
    return K


def _nearest(labels: np.ndarray, x: np.ndarray, y: np.ndarray, border: int) -> np.ndarray:
    return cv2.remap(labels, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=(border,))


def straight_points(points: np.ndarray, distorted: AnyCameras, straight: AnyCameras, index: int) -> np.ndarray:
    """Return the places of a distorted view's pixels [P, 2] (centres at + 0.5) in the straight one, [P, 2] float64."""
    if not has_lens(distorted, index) or len(points) == 0:
        return points
    sizes = [(int(cameras.width[index]), int(cameras.height[index])) for cameras in (distorted, straight)]
    K, new_K = (_intrinsics(cameras, index, *size) for cameras, size in zip((distorted, straight), sizes, strict=True))
    return _straight(points - 0.5, distorted, index, K, new_K) + 0.5


def _straight(pixels: np.ndarray, distorted: AnyCameras, index: int, K: np.ndarray, new_K: np.ndarray) -> np.ndarray:
    """Return the places of pixels [P, 2] (centres at whole numbers) in the straight view with K ``new_K``."""
    fisheye, lens = _opencv_lens(distorted, index)
    pixels = np.ascontiguousarray(pixels.reshape(-1, 1, 2))
    if fisheye:
        return cv2.fisheye.undistortPoints(pixels, K, lens, None, new_K)[:, 0]
    exact = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    return cv2.undistortPointsIter(pixels, K, lens, np.eye(3), new_K, exact)[:, 0]
