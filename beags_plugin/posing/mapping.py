"""Structure from motion on a database of features: matches of chosen pairs, poses, points and lenses."""

from __future__ import annotations

import copy
import tempfile
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from beags_plugin.posing.features import LARGEST
from beags_plugin.system.reading.images import read_image

SEED = 0
AT_ONCE = 40  # pairs between two reports of progress
SMALLEST = 3  # photos of a group that is reported
ENOUGH = 6  # photos of a lens that determine its distortion
FEWEST_POINTS = 15
"""Points that a photo must show to get a pose; with COLMAP's 30, sparse photos fall apart into groups."""
LENS = "OPENCV"
ROUNDS = 3  # rounds of the last adjustment; each drops the points that the one before has shown to be wrong
MIDDLE_KNOWN = 0.03  # degrees of standard deviation below which the principal point counts as determined
MIDDLE_CLEAR = 30.0  # standard deviations from the middle of the photo beyond which it counts too
LARGEST_ERROR = 2.0  # pixels of reduced photos, as all pixels here
SMALLEST_ANGLE = 1.5  # degrees


def match(
    database: Path, keys: Sequence[str], pairs: Sequence[tuple[int, int]], progress: Callable[[int, int], None]
) -> None:
    """Match the features of pairs and keep matches that a camera's motion explains; skips pairs already matched."""
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions(use_gpu=False)
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = SEED
    for first in range(0, len(pairs), AT_ONCE):
        batch = pairs[first : first + AT_ONCE]
        with tempfile.NamedTemporaryFile("w", suffix=".txt", encoding="utf-8") as file:
            file.writelines(f"{keys[one]} {keys[other]}\n" for one, other in batch)
            file.flush()
            pairing = pycolmap.ImportedPairingOptions(match_list_path=file.name)
            pycolmap.match_image_pairs(database, matching, pairing, geometry, pycolmap.Device.cpu)
        progress(min(first + AT_ONCE, len(pairs)), len(pairs))


def place(database: Path, folder: Path, keys: Sequence[str], progress: Callable[[int, int], None]) -> list[Any]:
    """Find poses photo by photo; returns pycolmap's reconstructions of unconnected groups, the largest first.

    folder: scratch folder of pycolmap. keys: the photos to use; a database may hold others.
    """
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(
        random_seed=SEED, min_model_size=SMALLEST, num_threads=1, extract_colors=False, image_names=keys
    )
    options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.mapper.abs_pose_min_num_inliers = FEWEST_POINTS
    done, total = 0, len(keys)

    def placed() -> None:
        nonlocal done
        done = min(done + 1, total)
        progress(done, total)

    pycolmap.set_random_seed(SEED)
    models = pycolmap.incremental_mapping(database, folder, folder, options, next_image_callback=placed)
    progress(total, total)
    for model in models.values():
        for image in model.images.values():
            image.name = unquote(image.name)
    return sorted(models.values(), key=lambda one: -one.num_reg_images())


def refine(model: Any, progress: Callable[[int, int], None]) -> Any:
    """Return the model with poses, points and lenses adjusted together, now with all parameters of distortion.

    Few photos can hardly tell a shifted principal point from a turn of the camera. It therefore moves from the middle
    of the photo only where it is well determined (``MIDDLE_KNOWN``) or clearly elsewhere (``MIDDLE_CLEAR``). A lens
    with fewer than ``ENOUGH`` photos is not adjusted.
    """
    import pycolmap

    photos = [model.images[image_id].camera_id for image_id in model.reg_image_ids()]
    for camera_id, camera in model.cameras.items():
        lens = pycolmap.Camera.create_from_model_name(
            camera_id, LENS, camera.mean_focal_length(), camera.width, camera.height
        )
        params = lens.params
        params[2:5] = camera.principal_point_x, camera.principal_point_y, camera.params[-1]
        camera.model, camera.params = lens.model, params
    few = [camera_id for camera_id in model.cameras if photos.count(camera_id) < ENOUGH]
    _adjust(model, few, middle=False)
    progress(1, 2)
    shifted = copy.deepcopy(model)
    _adjust(shifted, few, middle=True)
    progress(2, 2)
    if len(vague := [*few, *_vague_middles(shifted, few)]) == len(few):
        return shifted
    if len(vague) < len(model.cameras):
        _adjust(model, vague, middle=True)
    return model


def at_photo_size(model: Any, sizes: Mapping[str, tuple[int, int]]) -> None:
    """Change lenses and points of reduced photos to those of the photos. sizes: width and height by photo."""
    for camera_id, camera in model.cameras.items():
        images = [image for image in model.images.values() if image.camera_id == camera_id]
        width, height = sizes[images[0].name]
        factors = np.array([width / camera.width, height / camera.height])
        if (factors == 1).all():
            continue
        camera.rescale(width, height)
        for image in images:
            for point in image.points2D:
                point.xy = point.xy * factors
    model.update_point_3d_errors()


def color_points(model: Any, folder: Path) -> None:
    """Give each point the mean colour of its features. folder: of the photos, large ones of which are decoded smaller.

    COLMAP's own function decodes each photo whole: 96 photos of 12 megapixels take 15 seconds.
    """
    import cv2

    sums: defaultdict[int, np.ndarray] = defaultdict(lambda: np.zeros(4))
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        photo = read_image(folder / image.name, lambda file: np.array(file.convert("RGB")), "the photo", enough=LARGEST)
        if not (seen := [point for point in image.points2D if point.has_point3D()]):
            continue
        factor = photo.shape[1] / model.cameras[image.camera_id].width
        x, y = (np.array([point.xy for point in seen], np.float32) * np.float32(factor) - 0.5).T[..., None]
        colors = cv2.remap(photo, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
        for point, color in zip(seen, colors, strict=True):
            sums[point.point3D_id] += [*color, 1]
    for point_id, total in sums.items():
        model.points3D[point_id].color = np.round(total[:3] / total[3]).astype(np.uint8)


def _adjust(model: Any, constant: list[int], middle: bool) -> None:
    """Adjust a model without the ``constant`` lenses; middle: also adjust principal points."""
    import pycolmap

    for _ in range(ROUNDS):
        _problem(model, constant, middle).solve()
        manager = pycolmap.ObservationManager(model)
        manager.filter_all_points3D(LARGEST_ERROR, SMALLEST_ANGLE)
        manager.filter_observations_with_negative_depth()
    model.update_point_3d_errors()


def _problem(model: Any, constant: list[int], middle: bool) -> Any:
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=middle, print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = 1.0  # pixel of a reduced photo
    options.ceres.solver_options.function_tolerance = 1e-6  # hundreds of photos take minutes otherwise
    options.ceres.solver_options.num_threads = 1  # more add in another order each time, and save 4 % of the time
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    for camera_id in constant:
        config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, model)


def _vague_middles(model: Any, few: list[int]) -> list[int]:
    """Return the lenses, except those of few photos, whose principal point the photos do not determine."""
    import pycolmap

    problem = _problem(model, few, middle=True)
    covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, problem)
    vague = []
    for camera_id in set(model.cameras) - set(few):
        camera = model.cameras[camera_id]
        own = None if covariance is None else covariance.get_other_params_cov(camera.params)
        if own is None:
            vague.append(camera_id)
            continue
        deviation = model.compute_mean_reprojection_error() * np.sqrt(np.diag(own)[2:4])  # x and y, in pixels
        shift = np.abs(camera.params[2:4] - [camera.width / 2, camera.height / 2])
        known = deviation.max() < np.deg2rad(MIDDLE_KNOWN) * camera.mean_focal_length()
        if not known and (shift / deviation).max() < MIDDLE_CLEAR:
            vague.append(camera_id)
    return vague
