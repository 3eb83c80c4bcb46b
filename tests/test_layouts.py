"""Every layout from its exact file tree: recognition, split, intrinsics of scaled images, ids and names."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from data_folders import (
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    SCENES,
    WIDTH,
    noise,
    write_colmap,
    write_image,
    write_transforms,
)
from layout_folders import (
    FOCAL,
    ids,
    opencv_matrices,
    write_3dovs,
    write_copies,
    write_dtu,
    write_lerf_mask,
    write_llff,
    write_mipnerf360,
    write_poses_bounds,
    write_spin_nerf,
)

import beags_plugin.data.files as files
from beags_plugin.data import LAYOUTS
from beags_plugin.data.layout import Layout, find_layout
from beags_plugin.data.layouts.dtu import decompose
from beags_plugin.data.scene import PoseTable, Scene
from beags_plugin.errors import UserError
from beags_plugin.plugin.cameras import camera_from_nerfstudio
from beags_plugin.plugin.dataparser import BeagsDataParserConfig
from beags_plugin.plugin.dataset import BeagsDataset

AS_GIVEN = dict(orientation_method="none", center_method="none", auto_scale_poses=False)
POINT = np.array([0.3, -0.2, 0.4])


def parse(root: Path, split: str = "train", **options):
    return BeagsDataParserConfig(data=root, **options).setup().get_dataparser_outputs(split)


def names(outputs) -> list[str]:
    return [path.stem for path in outputs.image_filenames]


def pixel(outputs, index: int, point) -> np.ndarray:
    """Where the method's camera of a view sees a point of the outputs' world."""
    camera = camera_from_nerfstudio(outputs.cameras, index)
    x, y, w = camera.K.double().numpy() @ (camera.viewmat.double().numpy()[:3] @ [*point, 1.0])
    return np.array([x / w, y / w])


def moved(outputs, point) -> np.ndarray:
    """A point of the file's world in the outputs'."""
    transform = outputs.dataparser_transform.double().numpy()
    return outputs.dataparser_scale * (transform[:, :3] @ point + transform[:, 3])


def title(root: Path, layout: str = "auto") -> str:
    return find_layout(root, layout).title


def test_the_registry_names_all_layouts():
    expected = {"3dovs", "colmap", "dtu", "lerf-mask", "llff", "mipnerf360", "nerfstudio", "spin-nerf"}
    assert set(LAYOUTS.names()) >= expected
    assert all(issubclass(LAYOUTS.get(name), Layout) for name in expected)


# --- Mip-NeRF 360, COLMAP, nerfstudio -----------------------------------------------------------------------------


@pytest.mark.parametrize(("largest", "factor", "size"), [(1600, 1, (20, 12)), (10, 2, (10, 6)), (5, 4, (5, 3))])
def test_mipnerf360_takes_the_largest_copies_that_are_small_enough(tmp_path, monkeypatch, largest, factor, size):
    stems = write_mipnerf360(tmp_path)
    monkeypatch.setattr(files, "LARGEST_WIDTH", largest)
    assert title(tmp_path) == "Mip-NeRF 360"
    outputs = parse(tmp_path, **AS_GIVEN)
    assert outputs.image_filenames[0].parent.name == ("images" if factor == 1 else f"images_{factor}")
    camera = camera_from_nerfstudio(outputs.cameras, 0)
    assert (camera.width, camera.height) == size
    expected = [[FX / factor, 0, CX / factor], [0, FY / factor, CY / factor], [0, 0, 1]]
    np.testing.assert_allclose(camera.K.numpy(), expected, rtol=1e-6)
    assert names(parse(tmp_path, "test")) == [stems[0], stems[8]]
    assert names(outputs) == stems[1:8] + stems[9:]


def test_mipnerf360_masks_and_ground_truth_of_both_kinds(tmp_path):
    stems = write_mipnerf360(tmp_path)
    write_image(tmp_path / f"masks/{stems[1]}.png", ids(3))
    (tmp_path / "classes.json").write_text('{"3": "table"}')
    write_image(tmp_path / f"ground_truth/visible/table/{stems[8]}.png", ids(255))
    write_image(tmp_path / f"ground_truth/silhouettes/table/{stems[0]}.png", ids(255))
    outputs = parse(tmp_path, "test")
    assert outputs.metadata["classes"] == {0: "background", 3: "table"}
    truth = outputs.metadata["ground_truth"]
    assert truth["visible"] == {"table": [None, tmp_path / f"ground_truth/visible/table/{stems[8]}.png"]}
    assert truth["silhouettes"] == {"table": [tmp_path / f"ground_truth/silhouettes/table/{stems[0]}.png", None]}
    labels = BeagsDataset(parse(tmp_path)).get_data(0)["class_map"].numpy()
    np.testing.assert_array_equal(labels, ids(3))


@pytest.mark.parametrize("text", [False, True])
def test_colmap_in_binary_and_text(tmp_path, text, capsys):
    write_colmap(tmp_path, text=text)
    assert title(tmp_path) == "COLMAP"
    outputs = parse(tmp_path, **AS_GIVEN)
    K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
    x, y, w = K @ (opencv_matrices(9)[1] @ [*POINT, 1.0])[:3]
    np.testing.assert_allclose(pixel(outputs, 0, moved(outputs, POINT)), [x / w, y / w], atol=1e-3)
    said = " ".join(capsys.readouterr().out.split())
    assert "COLMAP layout, poses of sparse/0, 9 images in images (2 held out), no masks, random seed points." in said


def test_nerfstudio_comes_before_colmap(tmp_path):
    write_colmap(tmp_path)
    write_transforms(tmp_path)
    assert title(tmp_path) == title(tmp_path / "transforms.json") == "nerfstudio"
    assert title(tmp_path, "colmap") == "COLMAP"


# --- LLFF ---------------------------------------------------------------------------------------------------------


def test_llff_scales_the_intrinsics_to_the_images_and_turns_the_axes(tmp_path):
    root = tmp_path / "fern"
    stems = write_llff(root)
    assert title(root) == "LLFF"
    outputs = parse(root, images_path=Path("images_4"), eval_interval=0, **AS_GIVEN)
    assert outputs.image_filenames[0] == root / "images_4/image000.png"
    for index, matrix in enumerate(opencv_matrices(len(stems))):
        if index != 1:
            x, y, z = (matrix @ [*POINT, 1.0])[:3]
            expected = [WIDTH / 2 + FOCAL * x / z, HEIGHT / 2 + FOCAL * y / z]
            np.testing.assert_allclose(pixel(outputs, index - (index > 1), POINT), expected, atol=1e-4)
    normalised = parse(root, images_path=Path("images_4"), eval_interval=0)
    expected = pixel(outputs, 0, POINT)
    np.testing.assert_allclose(pixel(normalised, 0, moved(normalised, POINT)), expected, atol=1e-3)


@pytest.mark.parametrize("known_by", ["images", "names", "copies"])
def test_llff_holds_out_the_view_that_nvos_scores(tmp_path, known_by, capsys):
    root = tmp_path / "fern"
    stems = write_llff(root, originals=known_by == "images")
    if known_by == "names":
        (root / "original_names.txt").write_text("image001.png IMG_4026.JPG\nimage003.png IMG_4027.JPG\n")
    target = {"images": ["image001"], "names": ["image003"], "copies": []}[known_by]
    outputs = parse(root, "test", images_path=Path("images_4"))
    assert names(outputs) == sorted(["image000", "image008", *target])
    assert set(names(parse(root, images_path=Path("images_4")))) == set(stems) - set(names(outputs))
    said = " ".join(capsys.readouterr().out.split())
    assert ("holds out IMG_4027, which no image here is called" in said) == (not target)
    assert not target or f"({2 + len(target)} held out, {target[0]} by protocol)" in said


def test_llff_with_colmap_pairs_renamed_copies_in_order(tmp_path):
    root = tmp_path / "fern"
    originals = [f"IMG_{4026 + index}.JPG" for index in range(10)]
    points = np.array([[0.1, 0.2, 0.3], [0.0, 0.1, -0.2]])
    write_colmap(root, names=originals, points=points)
    write_copies(root, [f"image{index:03d}.png" for index in range(10)], 2)
    for name in originals:
        (root / "images" / name).unlink()
    np.save(root / "poses_bounds.npy", np.zeros((10, 17)))  # COLMAP comes first: it knows the lens
    outputs = parse(root, "test")
    assert names(outputs) == ["image000", "image001", "image008"]
    K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
    x, y, w = K @ (opencv_matrices(10)[8] @ [*POINT, 1.0])[:3]
    np.testing.assert_allclose(pixel(outputs, 2, moved(outputs, POINT)), [x / w / 2, y / w / 2], atol=1e-3)
    np.testing.assert_allclose(outputs.metadata["points3D_xyz"][1], moved(outputs, points[1]), atol=1e-5)


@pytest.mark.parametrize("same_frame", [True, False])
def test_llff_takes_colmap_points_only_where_the_poses_look(tmp_path, same_frame):
    write_llff(tmp_path)
    other = tmp_path / "other"
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (40, 3))
    write_colmap(other, points=points if same_frame else points + 40.0)
    (tmp_path / "sparse/0").mkdir(parents=True)
    (other / "sparse/0/points3D.bin").rename(tmp_path / "sparse/0/points3D.bin")
    outputs = parse(tmp_path, images_path=Path("images_4"), num_random_points=300)
    assert outputs.metadata["points3D_random"] != same_frame
    assert len(outputs.metadata["points3D_xyz"]) == (40 if same_frame else 300)
    if same_frame:
        np.testing.assert_allclose(outputs.metadata["points3D_xyz"][7], moved(outputs, points[7]), atol=1e-5)


def test_llff_draws_points_between_the_bounds(tmp_path):
    stems = write_llff(tmp_path)
    write_poses_bounds(tmp_path, stems, 4, bounds=(2.5, 3.5))
    outputs = parse(tmp_path, images_path=Path("images_4"), num_random_points=400, **AS_GIVEN)
    points = outputs.metadata["points3D_xyz"].double().numpy()
    depths = np.stack([points @ m[2, :3] + m[2, 3] for m in opencv_matrices(10)])
    assert points.shape == (400, 3) and ((depths > 2.5 - 1e-4) & (depths < 3.5 + 1e-4)).any(axis=0).all()


def test_llff_knows_the_lens_from_the_camera_file(tmp_path):
    write_llff(tmp_path)
    (tmp_path / "sparse/0").mkdir(parents=True)
    cameras = tmp_path / "sparse/0/cameras.txt"
    cameras.write_text(f"1 SIMPLE_RADIAL {4 * WIDTH} {4 * HEIGHT} {4 * FOCAL} {2 * WIDTH} {2 * HEIGHT} 0.02\n")
    parameters = parse(tmp_path, images_path=Path("images_4")).cameras.distortion_params
    torch.testing.assert_close(parameters, torch.tensor([0.02, 0, 0, 0, 0, 0]).expand(8, 6))
    cameras.write_text(f"1 SIMPLE_RADIAL {WIDTH} {HEIGHT} {FOCAL} {WIDTH / 2} {HEIGHT / 2} 0.02\n")  # another camera
    assert not parse(tmp_path, images_path=Path("images_4")).cameras.distortion_params.any()


# --- LERF-Mask, 3D-OVS, SPIn-NeRF, DTU ----------------------------------------------------------------------------


def test_lerf_mask(tmp_path, capsys):
    stems = write_lerf_mask(tmp_path)
    assert title(tmp_path) == "LERF-Mask"
    outputs, test = parse(tmp_path), parse(tmp_path, "test")
    assert names(test) == ["frame_00041", "frame_00152"] and set(names(outputs)) == set(stems) - set(names(test))
    assert outputs.metadata["classes"] == {0: "background", 37: "class_37"}
    assert (BeagsDataset(outputs).get_data(2)["class_map"].numpy() == ids(37)).all()
    assert test.metadata["class_map_filenames"] == [None, None]
    truth, folder = test.metadata["ground_truth"]["visible"], tmp_path / "test_mask"
    assert truth == {
        "green apple": [folder / "0/green apple.png", folder / "1/green apple.png"],
        "old camera": [folder / "0/old camera.png", None],
    }
    assert "Exact masks of 'green apple', 'old camera' do not count" in " ".join(capsys.readouterr().out.split())
    (tmp_path / "classes.json").write_text('{"37": "green apple", "4": "old camera"}')
    assert parse(tmp_path).metadata["classes"][37] == "green apple"
    assert "do not count" not in capsys.readouterr().out


def test_prompts_of_lerf_mask_are_scored_by_class_name(tmp_path):
    """A run with the classes cup and box, of which the second test view alone has a mask of the cup."""
    from run_folders import write_trained

    from beags_plugin.plugin.evaluate import EvaluatedRun, evaluate_run

    write_lerf_mask(tmp_path / "figurines")
    write_image(tmp_path / "figurines/test_mask/1/cup.png", 255 * ids())
    config = write_trained(tmp_path / "run", tmp_path / "figurines")
    first, second = EvaluatedRun(config).views
    assert first.visible_objects is None and first.visible is None
    assert second.visible_objects is not None and list(second.visible_objects) == [1]
    assert (second.visible_objects[1].numpy() == (ids() > 0)).all()
    scored = {(mask.kind, mask.class_id, mask.view) for mask in evaluate_run(config).after.masks}
    assert scored == {("extracted", 1, 1), ("rendered", 1, 1)}


def test_the_masks_of_dtu_train_and_evaluate(tmp_path):
    """Three-channel masks as class maps of a data manager, and as silhouettes of the class called object."""
    from beags_plugin.plugin.config import base_config
    from beags_plugin.plugin.datamanager import BeagsDataManagerConfig
    from beags_plugin.plugin.evaluation_views import HeldOutViews

    write_dtu(tmp_path)
    config = base_config()
    config.pipeline.datamanager = BeagsDataManagerConfig(dataparser=BeagsDataParserConfig(data=tmp_path))
    views = HeldOutViews(config, {0: "background", 1: "object"})
    labels = views.manager.views("train")[2].labels
    assert labels is not None and (labels.numpy() == ids()).all()
    view = views[1]
    assert view.visible is not None and (view.visible.numpy() == ids()).all()
    assert view.silhouettes is not None and (view.silhouettes[1].numpy() == (ids() > 0)).all()


def test_3dovs(tmp_path):
    stems = write_3dovs(tmp_path)
    assert title(tmp_path) == "3D-OVS"
    test = parse(tmp_path, "test")
    assert names(test) == ["00", "04"] and names(parse(tmp_path)) == [stems[i] for i in (1, 2, 3, 5)]
    assert test.metadata["classes"] == {0: "background", 1: "red bag", 2: "banana", 3: "white sheet"}
    assert test.metadata["ground_truth"]["visible"]["banana"] == [
        tmp_path / f"segmentations/{view}/banana.png" for view in ("00", "04")
    ]
    write_image(tmp_path / "masks/01.png", ids(4))
    with pytest.raises(UserError, match=r"holds id 4, which .*classes\.txt does not name"):
        parse(tmp_path)
    write_image(tmp_path / "masks/01.png", ids(2))
    assert (BeagsDataset(parse(tmp_path)).get_data(0)["class_map"].numpy() == ids(2)).all()


def test_spin_nerf(tmp_path, capsys):
    stems = write_spin_nerf(tmp_path)
    assert title(tmp_path) == "SPIn-NeRF"
    outputs, test = parse(tmp_path), parse(tmp_path, "test")
    assert names(test) == [stems[3], stems[11]] and names(outputs) == stems[4:11]
    also = parse(tmp_path, "test", held_out=(stems[0], stems[5]))  # the first is left out unless one asks for it
    assert names(also) == [stems[i] for i in (0, 3, 5, 11)]
    assert "3 images before the first label are left out" in " ".join(capsys.readouterr().out.split())
    camera = camera_from_nerfstudio(outputs.cameras, 0)
    assert (camera.width, camera.height) == (WIDTH // 4, HEIGHT // 4)
    np.testing.assert_allclose(camera.K.numpy()[:2, 2], [CX / 4, CY / 4], rtol=1e-6)
    assert outputs.metadata["classes"] == {0: "background", 1: "object"}
    assert (BeagsDataset(outputs).get_data(0)["class_map"].numpy() == ids(1, WIDTH // 4, HEIGHT // 4)).all()


def test_spin_nerf_with_single_labels_leaves_nothing_out(tmp_path):
    stems = write_spin_nerf(tmp_path, gone=0)
    (tmp_path / f"images_4/label/{stems[5]}.png").unlink()
    assert names(parse(tmp_path, "test")) == [stems[0], stems[8]] and len(names(parse(tmp_path))) == 10


def test_dtu(tmp_path):
    projections, _ = write_dtu(tmp_path)
    assert title(tmp_path) == "DTU"
    outputs = parse(tmp_path, eval_interval=0, **AS_GIVEN)
    assert names(outputs)[:2] == ["000000", "000001"]
    for index, projection in enumerate(projections):
        x, y, w = projection @ [*POINT, 1.0]  # whole numbers are pixel centres there, halves here
        np.testing.assert_allclose(pixel(outputs, index, POINT), [x / w + 0.5, y / w + 0.5], atol=1e-3)
    assert outputs.metadata["classes"] == {0: "background", 1: "object"}
    assert outputs.metadata["class_map_filenames"][4] == tmp_path / "mask/004.png"
    assert (BeagsDataset(outputs).get_data(4)["class_map"].numpy() == ids()).all()
    assert names(parse(tmp_path, "test")) == ["000000", "000008"]
    silhouettes = parse(tmp_path, "test").metadata["ground_truth"]["silhouettes"]
    assert silhouettes == {"object": [tmp_path / "mask/000.png", tmp_path / "mask/008.png"]}


@pytest.mark.parametrize("factor", [1.0, -1.0, 40.0])
def test_a_projection_falls_apart_into_its_camera(factor):
    K = np.array([[900.0, 0.3, 410.0], [0, 880.0, 290.0], [0, 0, 1]])
    matrix = opencv_matrices(5)[3]
    found = decompose(factor * K @ matrix[:3])
    for part, expected in zip(found, (K, matrix[:3, :3], np.linalg.inv(matrix)[:3, 3]), strict=True):
        np.testing.assert_allclose(part, expected, atol=1e-9)


# --- choosing -----------------------------------------------------------------------------------------------------


def test_two_layouts_in_one_folder_are_told(tmp_path):
    write_dtu(tmp_path)
    write_poses_bounds(tmp_path, [f"{index:06d}.png" for index in range(9)], 1)
    with pytest.raises(UserError, match=r"cameras_sphere\.npz \(dtu\) and poses_bounds\.npy \(llff\): choose one"):
        parse(tmp_path)
    assert title(tmp_path, "dtu") == "DTU"
    assert len(parse(tmp_path, layout="dtu").image_filenames) == 7


def test_an_unknown_folder_is_told_what_was_looked_for(tmp_path):
    with pytest.raises(UserError, match=r"neither transforms\.json nor a COLMAP model .*poses_bounds\.npy \(llff\)"):
        parse(tmp_path)
    with pytest.raises(UserError, match="there is no layout 'llf': choose one of 3dovs, colmap"):
        parse(tmp_path, layout="llf")
    with pytest.raises(UserError, match=r"holds no cameras_sphere\.npz, which the layout dtu needs"):
        parse(tmp_path, layout="dtu")


class Turntable(Layout):
    """As another package might add it."""

    title = "turntable"
    marks = "turntable.txt"

    def missing(self, root: Path) -> str | None:
        return None if (root / "turntable.txt").is_file() else "no turntable.txt"

    def read(self, root: Path, images: Path | None) -> Scene:
        K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
        poses = np.linalg.inv(opencv_matrices(9)) @ np.diag([1.0, -1.0, -1.0, 1.0])
        shots = tuple(root / f"shot{index}.png" for index in range(9))
        sizes = np.full((9, 2), (WIDTH, HEIGHT))
        return Scene(self.title, root, PoseTable(root / "turntable.txt", shots, poses[:, :3], np.stack([K] * 9), sizes))


def test_another_package_can_add_a_layout(tmp_path, monkeypatch):
    monkeypatch.setitem(LAYOUTS._specs, "turntable", "test_layouts:Turntable")
    (tmp_path / "turntable.txt").touch()
    for index in range(9):
        write_image(tmp_path / f"shot{index}.png", noise(index))
    write_image(tmp_path / "masks/shot3.png", ids(6))
    assert title(tmp_path) == "turntable"
    outputs = parse(tmp_path)
    assert names(outputs) == [f"shot{index}" for index in range(1, 8)]
    assert outputs.metadata["classes"] == {0: "background", 6: "class_6"} and outputs.metadata["points3D_random"]


MISTAKES = {
    "poses": (lambda root: np.save(root / "poses_bounds.npy", np.ones((10, 15))), "no finite .views, 17. numbers"),
    "text": (lambda root: (root / "poses_bounds.npy").write_text("x"), r"poses_bounds\.npy cannot be read"),
    "empty": (lambda root: (root / "poses_bounds.npy").write_bytes(b""), r"poses_bounds\.npy cannot be read"),
    "image gone": (lambda root: (root / "images_4/image003.png").unlink(), "has 10 poses but .*images_4 9 images"),
    "no images": (lambda root: [p.unlink() for p in (root / "images_4").iterdir()], "images_4 holds no images"),
}


def check_refused(folder: Path, message: str, **options: Any) -> None:
    with pytest.raises(UserError, match=message) as raised:
        parse(folder, **options)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_told_in_one_sentence(tmp_path, mistake):
    write_llff(tmp_path)
    make, message = MISTAKES[mistake]
    make(tmp_path)
    check_refused(tmp_path, message, images_path=Path("images_4"))


def with_smaller_images(root: Path) -> None:
    for index, path in enumerate(sorted((root / "image").iterdir())):
        write_image(path, noise(index, WIDTH // 2, HEIGHT // 2))


def without_camera(root: Path) -> None:
    with np.load(root / "cameras_sphere.npz") as cameras:
        kept = {name: cameras[name] for name in cameras.files if name != "world_mat_3"}
    np.savez(root / "cameras_sphere.npz", **kept)


def with_skew(root: Path) -> None:
    with np.load(root / "cameras_sphere.npz") as cameras:
        entries = dict(cameras)
    entries["world_mat_2"] = (
        np.array([[1.0, 0.4, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ entries["world_mat_2"]
    )
    np.savez(root / "cameras_sphere.npz", **entries)


DTU_MISTAKES = {
    "camera gone": (without_camera, "has 8 cameras but there are 9 images"),
    "image gone": (lambda root: (root / "image/000003.png").unlink(), "has 9 cameras but there are 8 images"),
    "mask gone": (lambda root: (root / "mask/003.png").unlink(), "mask holds 8 masks for 9 images"),
    "smaller images": (with_smaller_images, "far from the middle of its 10x6 pixels: keep the images .* --images-path"),
    "skew": (with_skew, "world_mat_2 in .* is no camera with axes at right angles"),
    "half a file": (
        lambda root: (root / "cameras_sphere.npz").write_bytes(b"PK\x03\x04"),
        "cannot be read .*: restore",
    ),
}


@pytest.mark.parametrize("mistake", DTU_MISTAKES)
def test_mistakes_in_dtu_are_told_in_one_sentence(tmp_path, mistake):
    write_dtu(tmp_path)
    make, message = DTU_MISTAKES[mistake]
    make(tmp_path)
    check_refused(tmp_path, message)


def test_a_test_mask_of_no_view_is_told(tmp_path):
    write_lerf_mask(tmp_path)
    write_image(tmp_path / "test_mask/2/green apple.png", ids())
    with pytest.raises(UserError, match="test_mask/2 is for no test view, of which there are 2"):
        parse(tmp_path)


# --- all layouts --------------------------------------------------------------------------------------------------

COLMAP_K = [[FX, 0, CX], [0, FY, CY], [0, 0, 1]]
POSES_BOUNDS_K = [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
DTU_K = [[FX, 0, CX + 0.5], [0, FY, CY + 0.5], [0, 0, 1]]  # its pixel centres are whole numbers
# layout: how its fixture is written, the options to read it with, K and size of the images that are read
EVERY = {
    "nerfstudio": (write_transforms, {}, COLMAP_K, 1.0),
    "colmap": (write_colmap, {}, COLMAP_K, 1.0),
    "mipnerf360": (write_mipnerf360, {"images_path": Path("images_2")}, COLMAP_K, 0.5),
    "llff": (write_llff, {"images_path": Path("images_4")}, POSES_BOUNDS_K, 1.0),
    "lerf-mask": (write_lerf_mask, {}, COLMAP_K, 1.0),
    "3dovs": (write_3dovs, {}, POSES_BOUNDS_K, 1.0),
    "spin-nerf": (write_spin_nerf, {}, COLMAP_K, 0.25),
    "dtu": (write_dtu, {}, DTU_K, 1.0),
}


def every_layout(test):
    return pytest.mark.parametrize("layout", EVERY)(test)


def enlarged(path: Path) -> None:
    """The image or mask with twice as many pixels along each side."""
    from PIL import Image

    with Image.open(path) as image:
        larger = image.resize((2 * image.width, 2 * image.height), Image.Resampling.NEAREST)
    larger.save(path)


@every_layout
def test_intrinsics_follow_the_size_of_the_images(tmp_path, layout):
    write, options, K, factor = EVERY[layout]
    write(tmp_path)
    before = parse(tmp_path, layout=layout, **options)
    scale = np.diag([factor, factor, 1.0])
    np.testing.assert_allclose(camera_from_nerfstudio(before.cameras, 1).K.numpy(), scale @ K, rtol=1e-5)
    seen = pixel(before, 1, moved(before, POINT))
    if layout == "dtu":  # its poses do not say how large their images are: larger ones lie in a folder of their own
        shutil.copytree(tmp_path / "image", tmp_path / "copies")
        options = {"images_path": Path("copies")}
    for split in ("train", "test"):
        outputs = parse(tmp_path, split, layout=layout, **options)
        for path in (*outputs.image_filenames, *outputs.metadata["class_map_filenames"]):
            if path is not None:
                enlarged(path)
    after = parse(tmp_path, layout=layout, **options)
    camera = camera_from_nerfstudio(after.cameras, 1)
    assert (camera.width, camera.height) == (2 * factor * WIDTH, 2 * factor * HEIGHT)
    np.testing.assert_allclose(camera.K.numpy(), np.diag([2.0, 2.0, 1.0]) @ scale @ K, rtol=1e-5)
    np.testing.assert_allclose(pixel(after, 1, moved(after, POINT)), 2 * seen, atol=1e-3)


@every_layout
def test_ground_truth_has_a_folder_for_what_is_seen_and_one_for_what_is_hidden(tmp_path, layout):
    write, options, _, _ = EVERY[layout]
    write(tmp_path)
    stem = names(parse(tmp_path, "test", layout=layout, **options))[0]
    folder = tmp_path / "ground_truth"
    files = {kind: folder / kind / f"thing/{stem}.png" for kind in ("visible", "silhouettes", "seen")}
    for path in (*files.values(), folder / f"masks/{stem}.png"):
        write_image(path, ids(1))
    truth = parse(tmp_path, "test", layout=layout, **options).metadata["ground_truth"]
    for kind, path in files.items():
        assert truth[kind]["thing"][0] == path and not any(truth[kind]["thing"][1:])
    assert truth["masks"][0] == folder / f"masks/{stem}.png" and not any(truth["masks"][1:])
    train = parse(tmp_path, layout=layout, **options).metadata["ground_truth"]
    if set(names(parse(tmp_path, layout=layout, **options))).isdisjoint({stem}):
        assert not any(any(train[kind]["thing"]) for kind in files)


NVOS = {
    "fern": "IMG_4027", "flower": "IMG_2962", "fortress": "IMG_1800", "horns": "DJI_20200223_163024_597",
    "leaves": "IMG_2997", "orchids": "IMG_4480", "trex": "DJI_20200223_163619_411",
}  # fmt: skip


@pytest.mark.parametrize("scene", NVOS)
def test_nvos_holds_out_its_view_of_every_llff_scene(tmp_path, scene):
    """The table of the method, section 9; the view is one that the rule of every 8th would train on."""
    root = tmp_path / scene
    stems = [f"AAA_{index}" for index in range(3)] + [NVOS[scene]]  # "AAA" comes first in the order of names
    for index, stem in enumerate(stems):
        write_image(root / f"images_4/{stem}.png", noise(index))
    write_poses_bounds(root, stems, 4)
    assert title(root) == "LLFF"
    assert names(parse(root, "test")) == [stems[0], NVOS[scene]] and names(parse(root)) == stems[1:3]


# --- real captures ------------------------------------------------------------------------------------------------


def real(scene: str) -> Path:
    if not (SCENES / scene).is_dir():
        pytest.skip(f"the capture {scene} is not on this machine")
    return SCENES / scene


def test_fern_points_have_the_colours_of_the_images():
    """Poses, scaled intrinsics, lens and seed points agree: points meet their colours; mirrored they do not."""
    from PIL import Image

    root = real("fern")
    outputs, test = parse(root), parse(root, "test")
    assert title(root) == "LLFF" and len(names(outputs)) == 16
    assert names(test) == ["image000", "image001", "image008", "image016"]  # IMG_4027 is image001
    assert len(outputs.metadata["points3D_xyz"]) == 10091 and not outputs.metadata["points3D_random"]
    assert outputs.cameras.distortion_params[0, 0] == pytest.approx(0.01975, abs=1e-5)
    points = outputs.metadata["points3D_xyz"].double().numpy()
    colors = outputs.metadata["points3D_rgb"].double().numpy()
    camera = camera_from_nerfstudio(outputs.cameras, 5)
    x, y, z = (points @ camera.rotation.double().numpy().T + camera.translation.double().numpy()).T
    x, y = x / z, y / z
    lens = 1.0 + float(outputs.cameras.distortion_params[5, 0]) * (x * x + y * y)
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    columns, rows = np.floor(fx * x * lens + cx).astype(int), np.floor(fy * y * lens + cy).astype(int)
    inside = (z > 0) & (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    image = np.asarray(Image.open(outputs.image_filenames[5]).convert("RGB")).astype(float)
    error = np.abs(image[rows[inside], columns[inside]] - colors[inside]).mean(axis=1)
    mirrored = np.abs(image[rows[inside], camera.width - 1 - columns[inside]] - colors[inside]).mean(axis=1)
    assert inside.mean() > 0.5 and np.median(error) < 0.5 * np.median(mirrored)


def test_kitchen_is_mipnerf360():
    root = real("kitchen")
    assert title(root) == "Mip-NeRF 360"
    assert names(parse(root, "test")) == ["00", "08", "16", "24"] and len(names(parse(root))) == 21
