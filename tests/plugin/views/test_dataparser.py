from __future__ import annotations

import ast
import json
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
import rich
import torch
from data_folders import (
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    SCENES,
    WIDTH,
    look_at,
    noise,
    write_colmap,
    write_image,
    write_transforms,
)
from PIL import Image
from rich.console import Console

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.plugin.views.cameras import camera_from_nerfstudio
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.plugin.views.dataset import BeagsDataset
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import progress_bar

AS_GIVEN = dict(orientation_method="none", center_method="none", auto_scale_poses=False)


def parse(root: Path, split: str = "train", **options):
    return BeagsDataParserConfig(data=root, **options).setup().get_dataparser_outputs(split)


def test_what_it_says_stands_above_a_bar_not_on_it(tmp_path, monkeypatch):
    write_transforms(tmp_path)
    console = Console(file=StringIO(), force_terminal=True)
    monkeypatch.setattr(rich, "_console", console)
    with progress_bar("Evaluating"):
        parse(tmp_path)
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    line = f"{tmp_path}: nerfstudio layout"
    assert "Evaluating" in printed and printed.partition(line)[0].endswith("\x1b[2K")  # the bar's line is erased


def names(outputs) -> list[str]:
    return [path.stem for path in outputs.image_filenames]


def pixel(camera, point) -> np.ndarray:
    """Where the method's camera sees a world point."""
    moved = camera.viewmat.double().numpy()[:3] @ [*point, 1.0]
    x, y, w = camera.K.double().numpy() @ moved
    return np.array([x / w, y / w])


def skip_without(scene: str) -> Path:
    if not (SCENES / scene).is_dir():
        pytest.skip(f"the capture {scene} is not on this machine")
    return SCENES / scene


# --- poses and intrinsics -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("per_frame", [False, True])
def test_transforms_cameras_see_points_where_the_file_says(tmp_path, per_frame):
    poses = write_transforms(tmp_path, per_frame=per_frame)
    outputs = parse(tmp_path, eval_interval=0, **AS_GIVEN)
    assert names(outputs) == [f"v{i:02d}" for i in range(9)]
    point = np.array([0.3, -0.2, 0.4])
    for index, pose in enumerate(poses):
        x, y, z = pose[:3, :3].T @ (point - pose[:3, 3])  # OpenGL: y up, z backward
        cx = CX + 0.25 * index if per_frame else CX
        expected = [cx + FX * x / -z, CY - FY * y / -z]
        camera = camera_from_nerfstudio(outputs.cameras, index)
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        np.testing.assert_allclose(pixel(camera, point), expected, atol=1e-4)


@pytest.mark.parametrize(("text", "folder"), [(False, "sparse/0"), (True, "sparse/0"), (False, "colmap/sparse/0")])
def test_colmap_cameras_and_seed_points_agree_after_normalisation(tmp_path, text, folder):
    points = np.array([[0.2, 0.1, 0.3], [-0.4, 0.2, 0.0], [0.0, 0.0, 0.5]])
    matrices = write_colmap(tmp_path, text=text, folder=folder, points=points)
    outputs = parse(tmp_path, eval_interval=0)
    assert names(outputs) == [f"v{i:02d}" for i in range(9)]  # image ids run the other way
    assert outputs.metadata["points3D_rgb"].tolist() == [[10, 20, 30]] * 3
    assert outputs.metadata["points3D_rgb"].dtype == torch.uint8
    assert not outputs.metadata["points3D_random"]
    K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
    for index, matrix in enumerate(matrices):
        camera = camera_from_nerfstudio(outputs.cameras, index)
        for raw, moved in zip(points, outputs.metadata["points3D_xyz"].tolist(), strict=True):
            x, y, w = K @ (matrix[:3, :3] @ raw + matrix[:3, 3])
            np.testing.assert_allclose(pixel(camera, moved), [x / w, y / w], atol=1e-3)


def test_transform_and_scale_lead_back_to_the_original_world(tmp_path):
    write_transforms(tmp_path)
    given = parse(tmp_path, eval_interval=0, **AS_GIVEN).cameras.camera_to_worlds
    outputs = parse(tmp_path, eval_interval=0)
    back = outputs.transform_poses_to_original_space(outputs.cameras.camera_to_worlds, camera_convention="opengl")
    torch.testing.assert_close(back, given, atol=1e-5, rtol=0)


def test_downscaling_scales_each_axis_by_the_rounded_size(tmp_path):
    write_transforms(tmp_path)
    camera = camera_from_nerfstudio(parse(tmp_path, downscale_factor=3.0).cameras, 0)
    assert (camera.width, camera.height) == (7, 4)  # 20 / 3 is rounded up
    expected = [[FX * 7 / 20, 0, CX * 7 / 20], [0, FY / 3, CY / 3], [0, 0, 1]]
    np.testing.assert_allclose(camera.K.numpy(), expected, rtol=1e-6)


def test_cameras_follow_smaller_copies_of_the_images(tmp_path):
    write_colmap(tmp_path)
    for index in range(9):
        write_image(tmp_path / f"images_2/v{index:02d}.png", noise(index, 10, 6))
    camera = camera_from_nerfstudio(parse(tmp_path, images_path=Path("images_2")).cameras, 0)
    assert (camera.width, camera.height) == (10, 6)
    np.testing.assert_allclose(camera.K.numpy()[:2, 2], [CX / 2, CY / 2], rtol=1e-6)


# --- splits -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("write", [write_transforms, write_colmap])
def test_every_eighth_view_by_name_is_held_out(tmp_path, write):
    write(tmp_path)
    parser = BeagsDataParserConfig(data=tmp_path).setup()
    assert names(parser.get_dataparser_outputs("train")) == [f"v{i:02d}" for i in range(1, 8)]
    for split in ("val", "test"):
        outputs = parser.get_dataparser_outputs(split)
        assert names(outputs) == ["v00", "v08"]
        assert len(outputs.cameras) == len(outputs.metadata["mask_filenames"]) == 2


def test_held_out_views_leave_the_training_set(tmp_path):
    write_transforms(tmp_path)
    options = dict(eval_interval=4, held_out=("v03",))
    assert names(parse(tmp_path, "train", **options)) == ["v01", "v02", "v05", "v06", "v07"]
    assert names(parse(tmp_path, "test", **options)) == ["v00", "v03", "v04", "v08"]


def test_splits_named_by_the_data_win(tmp_path):
    write_transforms(
        tmp_path / "a", train_filenames=["images/v04.png", "images/v01.png"], test_filenames=["images/v02.png"]
    )
    assert [names(parse(tmp_path / "a", split)) for split in ("train", "test", "val")] == [
        ["v01", "v04"],
        ["v02"],
        ["v02"],
    ]
    write_colmap(tmp_path / "b")
    (tmp_path / "b/train_list.txt").write_text("v05.png\nv00.png\n")
    (tmp_path / "b/test_list.txt").write_text("v07.png\n")
    assert [names(parse(tmp_path / "b", split)) for split in ("train", "val")] == [["v00", "v05"], ["v07"]]


# --- masks --------------------------------------------------------------------------------------------------------


def labels_of(root: Path, index: int = 0, **options) -> np.ndarray:
    outputs = parse(root, eval_interval=0, **options)
    return BeagsDataset(outputs).get_data(index)["labels"]


@pytest.mark.parametrize("kind", ["8-bit", "16-bit", "palette"])
def test_class_maps_keep_their_ids(tmp_path, kind):
    write_transforms(tmp_path)
    ids = np.zeros((HEIGHT, WIDTH), np.uint8)
    ids[2:5, 3:9], ids[6:, 10:] = 1, 7
    if kind == "palette":
        image = Image.fromarray(ids, mode="P")
        image.putpalette([value for i in range(256) for value in (255 - i, i, i // 2)])
        (tmp_path / "masks").mkdir()
        image.save(tmp_path / "masks/v00.png")
    else:
        array = ids if kind == "8-bit" else np.where(ids == 7, IGNORE, ids).astype(np.uint16)
        write_image(tmp_path / "masks/v00.png", array)
    loaded = labels_of(tmp_path)
    assert loaded.dtype == torch.uint16
    expected = np.where(ids == 7, IGNORE, ids) if kind == "16-bit" else ids
    np.testing.assert_array_equal(loaded.numpy(), expected)
    classes = parse(tmp_path).metadata["classes"]
    assert set(classes) == ({0, 1} if kind == "16-bit" else {0, 1, 7})
    assert classes[0] == "background"


def test_ignore_ids_become_ignore_and_are_no_class(tmp_path):
    write_transforms(tmp_path)
    ids = np.full((HEIGHT, WIDTH), 255, np.uint8)
    ids[:4] = 2
    write_image(tmp_path / "masks/v00.png", ids)
    (tmp_path / "classes.json").write_text('{"2": "cup"}')
    loaded = labels_of(tmp_path, ignore_ids=(255,)).numpy()
    assert (loaded[:4] == 2).all() and (loaded[4:] == IGNORE).all()
    assert parse(tmp_path, ignore_ids=(255,)).metadata["classes"] == {0: "background", 2: "cup"}
    with pytest.raises(UserError, match=r"v00\.png holds id 255, which .*classes\.json does not name"):
        parse(tmp_path)


def test_missing_masks_are_ignore(tmp_path):
    write_transforms(tmp_path)
    write_image(tmp_path / "masks/v03.png", np.ones((HEIGHT, WIDTH), np.uint8))
    files = parse(tmp_path, eval_interval=0).metadata["mask_filenames"]
    assert [file and file.name for file in files] == [None] * 3 + ["v03.png"] + [None] * 5
    assert (labels_of(tmp_path, 0).numpy() == IGNORE).all()
    assert (labels_of(tmp_path, 3).numpy() == 1).all()


def test_masks_of_images_in_subfolders(tmp_path):
    poses = write_transforms(tmp_path)
    meta = json.loads((tmp_path / "transforms.json").read_text())
    meta["frames"] = meta["frames"][:2]
    for folder, frame in zip(("a", "b"), meta["frames"], strict=True):
        write_image(tmp_path / f"images/{folder}/same.png", noise(0))
        write_image(tmp_path / f"masks/{folder}/same.png", np.full((HEIGHT, WIDTH), ord(folder), np.uint8))
        frame["file_path"] = f"images/{folder}/same.png"
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    assert [int(labels_of(tmp_path, i)[0, 0]) for i in range(2)] == [ord("a"), ord("b")]
    assert len(poses) == 9
    (tmp_path / "masks/a/same.png").rename(tmp_path / "masks/same.png")
    with pytest.raises(UserError, match="could belong to 2 images"):
        parse(tmp_path)


def test_ground_truth_is_noted_where_it_is(tmp_path):
    write_transforms(tmp_path)
    assert parse(tmp_path).metadata["ground_truth"] is None
    write_image(tmp_path / "ground_truth/masks/v01.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    write_image(tmp_path / "ground_truth/silhouettes/cup/v02.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    write_image(tmp_path / "ground_truth/seen/cup/v02.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    truth = parse(tmp_path).metadata["ground_truth"]
    assert truth["seen"] == {"cup": [None, tmp_path / "ground_truth/seen/cup/v02.png"] + [None] * 5}
    assert truth["masks"] == [tmp_path / "ground_truth/masks/v01.png"] + [None] * 6
    assert truth["silhouettes"] == {"cup": [None, tmp_path / "ground_truth/silhouettes/cup/v02.png"] + [None] * 5}


# --- images -------------------------------------------------------------------------------------------------------


def test_downscaled_image_and_class_map_stay_aligned(tmp_path):
    write_transforms(tmp_path)
    columns = np.broadcast_to(np.arange(WIDTH, dtype=np.uint8), (HEIGHT, WIDTH))
    write_image(tmp_path / "images/v00.png", np.repeat(10 * columns[..., None], 3, axis=2))
    write_image(tmp_path / "masks/v00.png", np.ascontiguousarray(columns))
    data = BeagsDataset(parse(tmp_path, eval_interval=0, downscale_factor=4.0)).get_data(0)
    assert data["image"].shape == (3, 5, 3)
    # Columns 0..3 average to 1.5; the new pixel's centre lies on the edge between columns 1 and 2.
    np.testing.assert_allclose(data["image"][0, :, 0] * 255, 10 * (1.5 + 4 * np.arange(5)), atol=0.01)
    np.testing.assert_array_equal(data["labels"][0].numpy(), 2 + 4 * np.arange(5))
    odd = BeagsDataset(parse(tmp_path, eval_interval=0, downscale_factor=20 / 4)).get_data(0)["labels"]
    np.testing.assert_array_equal(odd[0].numpy(), 2 + 5 * np.arange(4))  # the middle one of five


def test_camera_res_scale_factor_scales_both_once_more(tmp_path):
    write_transforms(tmp_path)
    dataset = BeagsDataset(parse(tmp_path, eval_interval=0), scale_factor=0.5)
    camera = camera_from_nerfstudio(dataset.cameras, 0)
    data = dataset.get_data(0)
    assert data["image"].shape[:2] == data["labels"].shape == (camera.height, camera.width) == (6, 10)
    np.testing.assert_allclose(camera.K[0, 2], CX / 2)


def test_alpha_goes_on_black_and_grey_becomes_rgb(tmp_path):
    write_transforms(tmp_path)
    rgba = np.full((HEIGHT, WIDTH, 4), 200, np.uint8)
    rgba[:, 5:, 3] = 0
    rgba[:, :5, 3] = 255
    write_image(tmp_path / "images/v00.png", rgba)
    write_image(tmp_path / "images/v01.png", np.full((HEIGHT, WIDTH), 77, np.uint8))
    dataset = BeagsDataset(parse(tmp_path, eval_interval=0))
    image = dataset.get_data(0, "uint8")["image"]
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert (image[:, :5] == 200).all() and (image[:, 5:] == 0).all()
    assert (dataset.get_data(1, "uint8")["image"] == 77).all()


# --- seed points --------------------------------------------------------------------------------------------------


def test_ply_seed_points_move_with_the_cameras(tmp_path):
    vertices = "0.1 0.2 0.3 9 8 7\n-0.5 0.0 0.25 255 0 1\n"
    header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property uchar {color}\n" for color in ("red", "green", "blue")) + "end_header\n"
    (tmp_path / "seed.ply").write_text(header + vertices)
    poses = write_transforms(tmp_path, ply_file_path="seed.ply")
    outputs = parse(tmp_path, eval_interval=0)
    assert outputs.metadata["points3D_rgb"].tolist() == [[9, 8, 7], [255, 0, 1]]
    for index in (0, 5):
        x, y, z = poses[index][:3, :3].T @ (np.array([-0.5, 0.0, 0.25]) - poses[index][:3, 3])
        camera = camera_from_nerfstudio(outputs.cameras, index)
        moved = outputs.metadata["points3D_xyz"][1].tolist()
        np.testing.assert_allclose(pixel(camera, moved), [CX + FX * x / -z, CY - FY * y / -z], atol=1e-3)


@pytest.mark.parametrize("kind", ["around", "forward", "outward"])
def test_random_points_lie_in_common_view(tmp_path, kind):
    poses = {
        "around": None,
        "forward": [look_at((0.1 * i, 5.0, 0.05 * (i % 3)), (0.1 * i, 0.0, 0.05 * (i % 3))) for i in range(9)],
        "outward": [
            look_at((0.1 * np.cos(i), 0.1 * np.sin(i), 0), (9 * np.cos(i), 9 * np.sin(i), 0)) for i in range(9)
        ],
    }[kind]
    write_transforms(tmp_path, poses=poses)
    outputs = parse(tmp_path, eval_interval=0, num_random_points=500)
    points = outputs.metadata["points3D_xyz"]
    assert outputs.metadata["points3D_random"] and points.shape == (500, 3) and points.isfinite().all()
    assert outputs.metadata["points3D_rgb"].shape == (500, 3)
    seen = np.zeros(500)
    for index in range(9):
        camera = camera_from_nerfstudio(outputs.cameras, index)
        moved = points @ camera.rotation.T + camera.translation
        x, y, w = (moved @ camera.K.T).T
        seen += ((w > 0) & (x > 0) & (x < WIDTH * w) & (y > 0) & (y < HEIGHT * w)).numpy()
    assert (seen >= (1 if kind == "outward" else 4.5)).mean() > 0.99

    again = parse(tmp_path, eval_interval=0, num_random_points=500).metadata["points3D_xyz"]
    assert torch.equal(points, again)


# --- paths and imports --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("module", ["dataparser", "poses", "colmap_files", "cameras", "seed_points"])
def test_no_import_of_a_data_manager(module):
    import beags_plugin.plugin.views

    source = (Path(beags_plugin.plugin.views.__path__[0]) / f"{module}.py").read_text()
    imported = [node.module or "" for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ImportFrom)]
    assert imported and not any("datamanager" in name for name in imported)


# --- mistakes -----------------------------------------------------------------------------------------------------


def edit(root: Path, change) -> None:
    meta = json.loads((root / "transforms.json").read_text())
    change(meta)
    (root / "transforms.json").write_text(json.dumps(meta))


MISTAKES = {  # others are in tests/mistakes
    "mirrored": (lambda root: edit(root, lambda m: mirror(m["frames"][0])), "not a rotation and a translation"),
    "k4": (lambda root: edit(root, lambda m: m.update(k4=0.1)), "k4 != 0"),
    "two images of one name": (
        lambda root: [
            Image.fromarray(noise(3)).save(root / "images/v01.jpg"),
            edit(root, lambda meta: meta["frames"][0].update(file_path="images/v01.jpg")),
        ],
        "v01.jpg and .*v01.png are both called v01, by which their masks are found: rename one of them, in the poses",
    ),
    "two copies of one image": (
        lambda root: [
            (root / "transforms.json").unlink(),
            write_colmap(root, names=["v00.png", "v01.png", "v02.png"]),
            (root / "images/v01.png").rename(root / "images/v01.bmp"),
            (root / "images/v02.png").rename(root / "images/v01.webp"),
        ],
        r"v01.png does not exist, and .*v01.bmp or .*v01.webp could stand for it: remove one of them",
    ),
}


def mirror(frame) -> None:
    for row in frame["transform_matrix"][:3]:
        row[0] = -row[0]


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_described_in_one_sentence(tmp_path, mistake):
    write_transforms(tmp_path)
    make, message = MISTAKES[mistake]
    make(tmp_path)
    parser = BeagsDataParserConfig(data=tmp_path).setup()
    with pytest.raises(UserError, match=message) as raised:
        for split in ("train", "val"):
            parser.get_dataparser_outputs(split)
    assert "\n" not in str(raised.value)


def test_wrong_options(tmp_path):
    write_transforms(tmp_path)
    with pytest.raises(UserError, match="downscale_factor is nan"):
        parse(tmp_path, downscale_factor=float("nan"))
    with pytest.raises(UserError, match="no COLMAP model"):
        parse(tmp_path, layout="colmap")


# --- real captures ------------------------------------------------------------------------------------------------


def test_fruit_reprojects_and_its_masks_fit():
    from nerfstudio.data.utils.colmap_parsing_utils import read_images_binary, read_points3D_binary

    root = skip_without("fruit")
    outputs = parse(root)
    assert len(outputs.image_filenames) == 70 and len(names(parse(root, "test"))) == 11
    assert outputs.metadata["classes"] == {0: "background", 1: "apple", 2: "banana"}
    views = {image.name: image for image in read_images_binary(root / "sparse/0/images.bin").values()}
    position = {key: i for i, key in enumerate(read_points3D_binary(root / "sparse/0/points3D.bin"))}
    view = views[outputs.image_filenames[5].name]
    tracked = view.point3D_ids >= 0
    points = outputs.metadata["points3D_xyz"][[position[i] for i in view.point3D_ids[tracked]]]
    camera = camera_from_nerfstudio(outputs.cameras, 5)
    moved = (points @ camera.rotation.T + camera.translation) @ camera.K.T
    error = np.linalg.norm((moved[:, :2] / moved[:, 2:]).numpy() - view.xys[tracked], axis=1)
    assert np.median(error) < 1.0  # the reconstruction's mean error is 0.74 px
    data = BeagsDataset(outputs).get_data(5)
    assert data["image"].shape[:2] == data["labels"].shape == (camera.height, camera.width)
    assert set(np.unique(data["labels"].numpy())) <= {0, 1, 2}


def test_skull_has_no_seed_points_but_starts_around_the_skull():
    root = skip_without("dtu_skull")
    outputs = parse(root, downscale_factor=2.0, num_random_points=2000)
    assert len(outputs.image_filenames) == 42
    centre = outputs.cameras.cx / outputs.cameras.width
    assert centre.std() > 0 or (centre - 0.5).abs().max() > 1e-3  # off-centre principal points are kept
    # The skull is inside the unit sphere of the file's world.
    points = outputs.metadata["points3D_xyz"].double()
    transform = outputs.dataparser_transform.double()
    original = (points / outputs.dataparser_scale - transform[:, 3]) @ transform[:, :3]
    assert (original.norm(dim=1) < 1).double().mean() > 0.1
    data = BeagsDataset(outputs).get_data(3)
    assert data["image"].shape[:2] == data["labels"].shape == (300, 400)
