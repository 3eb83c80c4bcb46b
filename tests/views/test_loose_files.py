"""Files that nearly are what their format says: seed points, poses, photos and masks of many programs."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from data_folders import HEIGHT, WIDTH, noise, write_colmap, write_image, write_transforms
from layout_folders import write_llff
from parsed_views import AS_GIVEN, names, parse

from beags_plugin.system.errors import UserError
from beags_plugin.views.cameras import camera_from_nerfstudio

ALL = [f"v{index:02d}" for index in range(9)]


def edit(root, change) -> None:
    meta = json.loads((root / "transforms.json").read_text())
    change(meta)
    (root / "transforms.json").write_text(json.dumps(meta))


def write_points(root, name: str, rows: str, columns: str = "x y z", kind: str = "float") -> None:
    write_transforms(root, ply_file_path=name)
    lines = [f"property {kind} {column}" for column in columns.split()]
    lines += [f"property uchar {color}" for color in ("red", "green", "blue")]
    header = "\n".join(
        ["ply", "format ascii 1.0", f"element vertex {len(rows.splitlines())}", *lines, "end_header", ""]
    )
    (root / name).write_text(header + rows)


# --- seed points --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "columns"), [("points.PLY", "x y z"), ("points.ply", "X Y Z")])
def test_seed_points_in_capital_letters(tmp_path, name, columns):
    write_points(tmp_path, name, "0 0 0 255 0 0\n0.1 0 0 0 255 0\n", columns)
    found = parse(tmp_path).metadata
    assert not found["points3D_random"] and found["points3D_rgb"].tolist() == [[255, 0, 0], [0, 255, 0]]


@pytest.mark.parametrize("word", ["nan", "-nan(ind)", "1.#QNAN", "-inf", "1.#INF"])
def test_points_that_are_no_numbers_are_left_out_and_counted(tmp_path, word, capsys):
    write_points(tmp_path, "points.ply", f"0 0 0 255 0 0\n{word} 0 0 0 255 0\n0.1 0 0 0 0 255\n")
    found = parse(tmp_path).metadata
    assert found["points3D_rgb"].tolist() == [[255, 0, 0], [0, 0, 255]]
    assert f"1 of the 3 seed points in {tmp_path}/points.ply are no numbers: they are left" in capsys.readouterr().out


@pytest.mark.parametrize("text", [True, False])
def test_points_of_colmap_that_are_no_numbers_are_left_out(tmp_path, text):
    write_colmap(tmp_path, text=text, points=[[0, 0, 0], [float("nan"), 0, 0], [0.1, 0, 0]])
    found = parse(tmp_path).metadata["points3D_xyz"]
    assert len(found) == 2 and bool(found.isfinite().all())


def test_points_of_colmap_without_colours_are_grey(tmp_path):
    write_colmap(tmp_path, text=True, points=[[0, 0, 0]])
    path = tmp_path / "sparse/0/points3D.txt"
    path.write_text("1 0 0 0\n2 0.1 0 0\n")
    assert parse(tmp_path).metadata["points3D_rgb"].tolist() == [[128] * 3] * 2
    path.write_text("1 0 0 0 10 20\n")
    with pytest.raises(UserError, match="the line '1 0 0 0 10 20' is no point: id, x, y, z, red, green, blue"):
        parse(tmp_path)


@pytest.mark.parametrize("name", ["points.pcd", "points.xyz", "points.las"])
def test_points_of_another_format_are_named(tmp_path, name):
    write_transforms(tmp_path, ply_file_path=name)
    (tmp_path / name).write_text("0 0 0\n")
    with pytest.raises(UserError, match=f"the seed points .*{name} have a format that cannot be read: save them as"):
        parse(tmp_path)


# --- poses --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "kind"),
    [("opencv", "OPENCV"), ("pinhole", "PINHOLE"), ("perspective", "PINHOLE"), ("opencv_fisheye", "OPENCV_FISHEYE")],
)
def test_camera_models_in_small_letters_and_by_other_names(tmp_path, given, kind):
    write_transforms(tmp_path / "given")
    write_transforms(tmp_path / "usual")
    edit(tmp_path / "given", lambda meta: meta.update(camera_model=given))
    edit(tmp_path / "usual", lambda meta: meta.update(camera_model=kind))
    found, expected = (parse(tmp_path / name).cameras.camera_type for name in ("given", "usual"))
    assert found.equal(expected)


MATRICES = {
    "one list": lambda rows: [value for row in rows for value in row],
    "three rows in one list": lambda rows: [value for row in rows[:3] for value in row],
    "text": lambda rows: [[str(value) for value in row] for row in rows],
}


@pytest.mark.parametrize("form", MATRICES)
def test_matrices_as_programs_write_them(tmp_path, form):
    write_transforms(tmp_path)
    expected = parse(tmp_path, eval_interval=0).cameras.camera_to_worlds

    def change(meta):
        for frame in meta["frames"]:
            frame["transform_matrix"] = MATRICES[form](frame["transform_matrix"])

    edit(tmp_path, change)
    assert parse(tmp_path, eval_interval=0).cameras.camera_to_worlds.equal(expected)


def test_a_frame_without_a_pose_may_be_deleted(tmp_path):
    write_transforms(tmp_path)
    edit(tmp_path, lambda meta: meta["frames"][0].update(transform_matrix=None))
    with pytest.raises(UserError, match="has no transform_matrix of 4 x 4 numbers: give it one, or delete it"):
        parse(tmp_path)


def test_spaces_at_the_ends_of_names_and_tabs_in_texts(tmp_path):
    write_transforms(tmp_path)
    edit(tmp_path, lambda meta: [frame.update(file_path=f" {frame['file_path']} \n") for frame in meta["frames"]])
    path = tmp_path / "transforms.json"
    path.write_text(path.read_text().replace('"camera_model"', '"author": "a\tb", "camera_model"'))
    assert [path.stem for path in parse(tmp_path, eval_interval=0).image_filenames] == ALL


def test_names_of_windows_in_its_own_code_page(tmp_path):
    write_colmap(tmp_path, text=True, names=[f"Käfer {index}.png" for index in range(9)])
    path = tmp_path / "sparse/0/images.txt"
    path.write_bytes(path.read_text().encode("cp1252"))
    assert names(parse(tmp_path, eval_interval=0))[0] == "Käfer 0"


def rotation(root, change) -> None:
    """Change the words of the rotation of the first image in images.txt."""
    path = root / "sparse/0/images.txt"
    words = path.read_text().split(" ")
    path.write_text(" ".join([words[0], *map(change, words[1:5]), *words[5:]]))


def test_rotations_are_normalised_as_colmap_does(tmp_path):
    write_colmap(tmp_path, text=True)
    expected = parse(tmp_path, eval_interval=0).cameras.camera_to_worlds
    rotation(tmp_path, lambda word: str(2 * float(word)))
    assert (parse(tmp_path, eval_interval=0).cameras.camera_to_worlds - expected).abs().max() < 1e-6


@pytest.mark.parametrize("word", ["0", "nan"])
def test_rotations_of_no_length_are_refused(tmp_path, word):
    write_colmap(tmp_path, text=True)
    rotation(tmp_path, lambda _: word)
    with pytest.raises(UserError, match=r"images.txt gives v00.png a pose that is no number: export the model again"):
        parse(tmp_path)


def test_tables_of_llff_in_whole_numbers_and_with_none(tmp_path):
    write_llff(tmp_path)
    table = tmp_path / "poses_bounds.npy"
    rows = np.load(table)
    rows[2, 16] = np.nan
    np.save(table, rows)
    with pytest.raises(UserError, match="poses_bounds.npy hold a value such as NaN that is not finite"):
        parse(tmp_path)
    np.save(table, rows[:, :15].astype(np.float32))
    with pytest.raises(UserError, match=re.escape("poses_bounds.npy are [10, 15] of float32 instead of [views, 17]")):
        parse(tmp_path)


# --- photos and masks ---------------------------------------------------------------------------------------------


def test_missing_photos_between_numbers_that_count_from_anywhere(tmp_path, capsys):
    """The first and the last are there, so that the numbers tell which are not."""
    write_llff(tmp_path, originals=False)
    folder = tmp_path / "images_4"
    for index, path in enumerate(sorted(folder.iterdir())):
        path.rename(folder / f"IMG_{4026 + index}.png")
    full = parse(tmp_path, eval_interval=0, images_path=folder, **AS_GIVEN)
    (folder / "IMG_4029.png").unlink()
    outputs = parse(tmp_path, eval_interval=0, images_path=folder, **AS_GIVEN)
    kept = [index for index, path in enumerate(full.image_filenames) if path.stem != "IMG_4029"]
    assert outputs.cameras.camera_to_worlds.equal(full.cameras.camera_to_worlds[kept])
    assert (
        f"1 of the {len(full.image_filenames)} photos" in (said := capsys.readouterr().out) and "IMG_4029.png" in said
    )
    (folder / "IMG_4026.png").unlink()
    with pytest.raises(UserError, match="keep the images that have poses"):
        parse(tmp_path, images_path=folder)


def test_hidden_files_beside_photos_are_none(tmp_path):
    write_llff(tmp_path)
    count = len(parse(tmp_path, eval_interval=0).image_filenames)
    for folder in tmp_path.glob("images*"):
        (folder / "._IMG_4026.JPG").write_bytes(b"\0\5\26\7")
    assert len(parse(tmp_path, eval_interval=0).image_filenames) == count


@pytest.mark.parametrize("suffix", [".PNG", ".png.png"])
def test_masks_in_capital_letters_and_by_the_photos_whole_name(tmp_path, suffix):
    write_transforms(tmp_path)
    write_image(tmp_path / f"masks/v03{suffix}", np.ones((HEIGHT, WIDTH), np.uint8))
    outputs = parse(tmp_path, eval_interval=0)
    assert outputs.metadata["mask_filenames"][3].name == f"v03{suffix}" and outputs.metadata["classes"][1] == "class_1"


@pytest.mark.parametrize("suffix", [".gif", ".npy", ".exr"])
def test_masks_of_no_image_that_is_read_are_not_overlooked(tmp_path, suffix):
    write_transforms(tmp_path)
    (tmp_path / "masks").mkdir()
    for stem in ALL:
        (tmp_path / f"masks/{stem}{suffix}").write_bytes(noise(0).tobytes())
    with pytest.raises(UserError, match=f"the masks in .*masks are {suffix} files, as v00{suffix}, but masks are .png"):
        parse(tmp_path)


def test_a_camera_follows_a_photo_in_capital_letters(tmp_path):
    write_transforms(tmp_path)
    for path in sorted((tmp_path / "images").iterdir()):
        path.rename(path.with_name(path.name.upper()))
    camera = camera_from_nerfstudio(parse(tmp_path, eval_interval=0).cameras, 0)
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
