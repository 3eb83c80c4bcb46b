"""Removing lens distortion from images of any size, as nerfstudio removes it from the photographs."""

from __future__ import annotations

import cv2
import numpy as np
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image

from beags_plugin.labels.class_ids import IGNORE


def has_lens(cameras: Cameras, index: int) -> bool:
    """Whether a view has lens distortion."""
    return cameras.distortion_params is not None and bool(cameras.distortion_params[index].any())


def undistort_image(image: np.ndarray, distorted: Cameras, index: int) -> np.ndarray:
    """An image [H, W, C] without its lens distortion and cropped, as nerfstudio does it; for a view with a lens."""
    return _by_nerfstudio(image, distorted, index)[1]


def straighten(cameras: Cameras) -> None:
    """Give cameras the K and size that their images have once undistorted, in place; no image is read for it."""
    known: dict[tuple, tuple] = {}  # most scenes have one camera for all views
    for index in range(len(cameras)):
        if not has_lens(cameras, index):
            continue
        parts = (cameras.fx, cameras.fy, cameras.cx, cameras.cy, cameras.width, cameras.height, cameras.camera_type)
        assert cameras.distortion_params is not None
        key = (*(float(part[index]) for part in parts), *cameras.distortion_params[index].tolist())
        if key not in known:
            blank = np.zeros((int(cameras.height[index]), int(cameras.width[index]), 3), np.uint8)
            K, image = _by_nerfstudio(blank, cameras, index)
            known[key] = (K, image.shape[:2])
        K, (height, width) = known[key]
        cameras.fx[index], cameras.fy[index] = float(K[0, 0]), float(K[1, 1])
        cameras.cx[index], cameras.cy[index] = float(K[0, 2]), float(K[1, 2])
        cameras.width[index], cameras.height[index] = width, height


def _by_nerfstudio(image: np.ndarray, distorted: Cameras, index: int) -> tuple[np.ndarray, np.ndarray]:
    """The new K [3, 3] and the image."""
    camera = distorted[index].reshape(())
    assert camera.distortion_params is not None
    K = camera.get_intrinsics_matrices().numpy()
    K, image, _ = _undistort_image(camera, camera.distortion_params.numpy(), {}, image, K)
    return K, image


def undistort_labels(labels: np.ndarray, distorted: Cameras, straight: Cameras, index: int) -> np.ndarray:
    """Remove the lens distortion from a class map; the nearest id is taken: ids never blend.

    labels: [h, w], the whole distorted image at any size. distorted, straight: the cameras before and after
    nerfstudio undistorted (and cropped) the photographs; ``index``: which of them.
    Returns [h', w'], the whole straight image at the same pixels per camera pixel; outside the lens IGNORE.
    """
    maps = _lens_maps(distorted, straight, index, labels.shape)
    if maps is None:
        return labels
    options = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": (IGNORE,)}
    return cv2.remap(labels, *maps, cv2.INTER_NEAREST, **options)


def redistort_labels(
    labels: np.ndarray,
    distorted: Cameras,
    straight: Cameras,
    index: int,
    shape: tuple[int, int],
    border: int = IGNORE,
) -> np.ndarray:
    """A class map of the straight view as the photograph's file has it: the inverse of ``undistort_labels``.

    labels: [h', w'], the whole straight image. shape: (h, w) of the distorted image, at as many pixels per camera
    pixel. Returns [h, w], the nearest value of each pixel; ``border`` where the straight image does not reach.
    """
    if distorted.distortion_params is None or not distorted.distortion_params[index].any():
        return labels
    height, width = shape
    parameters = distorted.distortion_params[index].double().numpy()
    sizes = [[int(getattr(c, side)[index]) for side in ("width", "height")] for c in (distorted, straight)]
    (full_width, full_height), (cropped_width, cropped_height) = sizes
    K = _scaled_intrinsics(distorted, index, width / full_width, height / full_height)
    new_K = _scaled_intrinsics(straight, index, labels.shape[1] / cropped_width, labels.shape[0] / cropped_height)
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    pixels = np.stack([columns, rows], axis=2).reshape(-1, 1, 2)
    if int(distorted.camera_type[index]) == CameraType.FISHEYE.value:
        found = cv2.fisheye.undistortPoints(pixels, K, parameters[:4], None, new_K)
    else:
        k1, k2, k3, _, p1, p2 = parameters  # nerfstudio's order; OpenCV wants k1, k2, p1, p2, k3
        exact = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
        found = cv2.undistortPointsIter(pixels, K, np.array([k1, k2, p1, p2, k3]), np.eye(3), new_K, exact)
    maps = found.reshape(height, width, 2).astype(np.float32)
    options = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": (border,)}
    return cv2.remap(labels, maps[..., 0], maps[..., 1], cv2.INTER_NEAREST, **options)


def undistort_alpha(alpha: np.ndarray, distorted: Cameras, straight: Cameras, index: int) -> np.ndarray:
    """Remove the lens distortion from an alpha channel [h, w] uint8, interpolated; outside the lens 0."""
    maps = _lens_maps(distorted, straight, index, alpha.shape)
    return alpha if maps is None else cv2.remap(alpha, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def _lens_maps(
    distorted: Cameras, straight: Cameras, index: int, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Where each pixel of the straight image lies in the distorted one of ``shape`` [h, w], x and y [h', w'] float32.

    None without distortion.
    """
    if distorted.distortion_params is None or not distorted.distortion_params[index].any():
        return None
    parameters = distorted.distortion_params[index].double().numpy()
    height, width = shape
    sizes = [[int(getattr(c, side)[index]) for side in ("width", "height")] for c in (distorted, straight)]
    (full_width, full_height), (cropped_width, cropped_height) = sizes
    new_size = (
        max(1, round(cropped_width * width / full_width)),
        max(1, round(cropped_height * height / full_height)),
    )
    K = _scaled_intrinsics(distorted, index, width / full_width, height / full_height)
    new_K = _scaled_intrinsics(straight, index, new_size[0] / cropped_width, new_size[1] / cropped_height)
    if int(distorted.camera_type[index]) == CameraType.FISHEYE.value:
        return cv2.fisheye.initUndistortRectifyMap(K, parameters[:4], np.eye(3), new_K, new_size, cv2.CV_32FC1)
    k1, k2, k3, _, p1, p2 = parameters  # nerfstudio's order; OpenCV wants k1, k2, p1, p2, k3
    coefficients = np.array([k1, k2, p1, p2, k3])
    return cv2.initUndistortRectifyMap(K, coefficients, np.eye(3), new_K, new_size, cv2.CV_32FC1)


def _scaled_intrinsics(cameras: Cameras, index: int, x_factor: float, y_factor: float) -> np.ndarray:
    """[3, 3] float64, K of the image scaled by these factors, for OpenCV, whose pixel centres are whole numbers."""
    K = cameras.get_intrinsics_matrices()[index].double().numpy()
    K = np.diag([x_factor, y_factor, 1.0]) @ K
    K[:2, 2] -= 0.5
    return K
