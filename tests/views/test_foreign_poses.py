"""Poses as other programs and other machines write them: names, paths, numbers and cameras."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from data_folders import CX, CY, FX, FY, HEIGHT, WIDTH, noise, write_colmap, write_image, write_transforms
from layout_folders import write_llff
from parsed_views import names, parse, title

from beags_plugin.system.errors import UserError
from beags_plugin.views.cameras import camera_from_nerfstudio


def edit(root: Path, change) -> dict:
    meta = json.loads((root / "transforms.json").read_text())
    change(meta)
    (root / "transforms.json").write_text(json.dumps(meta))
    return meta


def rename(root: Path, new) -> None:
    """Give every frame the path that ``new`` makes of "v00.png"."""
    edit(root, lambda meta: [frame.update(file_path=new(Path(frame["file_path"]).name)) for frame in meta["frames"]])


ALL = [f"v{index:02d}" for index in range(9)]

# --- names in COLMAP's text ---------------------------------------------------------------------------------------

SPACED = [f"left camera/IMG {index} (copy).png" for index in range(9)]


@pytest.mark.parametrize("text", [True, False])
def test_names_with_spaces_in_a_colmap_model(tmp_path, text):
    write_colmap(tmp_path, text=text, names=SPACED)
    assert names(parse(tmp_path, eval_interval=0)) == [Path(name).stem for name in SPACED]


@pytest.mark.parametrize("form", ["crlf", "bom", "utf-16", "no feature lines", "comments"])
def test_text_models_of_other_programs(tmp_path, form):
    write_colmap(tmp_path, text=True, names=SPACED, points=[[0.1, 0.2, 0.3]])
    for name in ("images.txt", "cameras.txt", "points3D.txt"):
        path = tmp_path / "sparse/0" / name
        content = path.read_text()
        if form == "no feature lines":
            content = "\n".join(line for line in content.splitlines() if line) + "\n"
        if form == "comments":
            content = f"# Image list with two lines of data per image:\n#   a, b\n{content}# the end\n"
        content = content.replace("\n", "\r\n") if form == "crlf" else content
        path.write_bytes(content.encode({"bom": "utf-8-sig", "utf-16": "utf-16"}.get(form, "utf-8")))
    outputs = parse(tmp_path, eval_interval=0)
    assert len(outputs.image_filenames) == 9 and not outputs.metadata["points3D_random"]


def test_features_of_names_with_spaces_and_dots(tmp_path):
    from beags_plugin.views.colmap_files import read_features

    write_colmap(tmp_path, text=True, names=["a b.1.png", "c.png"])
    path = tmp_path / "sparse/0/images.txt"
    first, _, rest = path.read_text().partition("\n\n")
    path.write_text(f"{first}\n5 6 18446744073709551615 10 3 7\n{rest}")
    ids, places = read_features(tmp_path / "sparse/0")["a b.1"]
    assert ids.tolist() == [-1, 7]
    np.testing.assert_allclose(places, [[5 / WIDTH, 6 / HEIGHT], [10 / WIDTH, 3 / HEIGHT]])


def test_names_of_windows_in_a_colmap_model(tmp_path):
    write_colmap(tmp_path, names=SPACED)
    images = tmp_path / "sparse/0/images.bin"
    images.write_bytes(images.read_bytes().replace(b"left camera/IMG", b"left camera\\IMG"))
    assert names(parse(tmp_path, eval_interval=0)) == [Path(name).stem for name in SPACED]


def test_lists_of_splits_have_names_with_spaces(tmp_path):
    write_colmap(tmp_path, text=True, names=SPACED)
    (tmp_path / "train_list.txt").write_bytes("\r\n".join(SPACED[2:]).encode("utf-8-sig"))
    (tmp_path / "test_list.txt").write_text("\n".join(SPACED[:2]))
    assert names(parse(tmp_path, "test")) == [Path(name).stem for name in SPACED[:2]]


def test_two_kinds_of_lenses_in_one_model(tmp_path):
    write_colmap(tmp_path, text=True)
    model = tmp_path / "sparse/0"
    lines = (model / "images.txt").read_text().replace(" 1 v03.png", " 2 v03.png")
    (model / "images.txt").write_text(lines)
    with (model / "cameras.txt").open("a") as file:
        file.write(f"2 OPENCV_FISHEYE {WIDTH} {HEIGHT} {FX} {FY} {CX} {CY} 0.01 0 0 0\n")
    kinds = parse(tmp_path, eval_interval=0).cameras.camera_type[:, 0].tolist()
    assert kinds[3] != kinds[0] and len(set(kinds)) == 2


# --- paths in transforms.json -------------------------------------------------------------------------------------

PATHS = {
    "backslashes": lambda name: f".\\images\\{name}",
    "a drive": lambda name: f"C:\\Users\\Me\\My scene\\images\\{name}",
    "a share": lambda name: f"\\\\server\\work\\scene\\images\\{name}",
    "a home of another machine": lambda name: f"/home/somebody/scene/images/{name}",
    "relative to another folder": lambda name: f"data/nerf/scene/images/{name}",
    "up and down": lambda name: f"../scene/images/{name}",
    "the name alone": lambda name: name,
    "no suffix": lambda name: f"./images/{Path(name).stem}",
    "another suffix": lambda name: f"images/{Path(name).stem}.JPG",
    "another case": lambda name: f"Images/{name.upper()}",
}


@pytest.mark.parametrize("form", PATHS)
def test_paths_of_other_machines_are_found(tmp_path, form):
    write_transforms(tmp_path / "scene")
    rename(tmp_path / "scene", PATHS[form])
    found = parse(tmp_path / "scene", eval_interval=0).image_filenames
    assert [path.resolve() for path in found] == [tmp_path / f"scene/images/{stem}.png" for stem in ALL]


def test_names_that_the_disk_writes_otherwise(tmp_path):
    """Accents in two parts, as macOS writes them, and escapes of web addresses."""
    write_transforms(tmp_path)
    (tmp_path / "images/v03.png").rename(tmp_path / "images/Ka\u0308fer 1.png")
    edit(tmp_path, lambda meta: [
        frame.update(file_path="images/K\u00e4fer%201.png") for frame in meta["frames"] if "v03" in frame["file_path"]
    ])  # fmt: skip
    assert len(parse(tmp_path, eval_interval=0).image_filenames) == 9


def test_dots_in_a_name_without_suffix_belong_to_it(tmp_path):
    write_transforms(tmp_path)
    for index in range(9):
        (tmp_path / f"images/v{index:02d}.png").rename(tmp_path / f"images/frame.{index:04d}.png")
    rename(tmp_path, lambda name: f"images/frame.{int(name[1:3]):04d}")
    assert names(parse(tmp_path, "test", held_out=("frame.0003",))) == ["frame.0000", "frame.0003", "frame.0008"]


def test_no_photo_stands_for_two_names(tmp_path):
    """One of two folders with equal names is missing: its poses must not get the other's photos."""
    write_transforms(tmp_path, count=12)
    for index in range(12):
        (tmp_path / f"images/v{index:02d}.png").rename(tmp_path / f"images/{index % 8}.png")
    rename(tmp_path, lambda name: f"{'images' if int(name[1:3]) < 8 else 'right'}/{int(name[1:3]) % 8}.png")
    outputs = parse(tmp_path, eval_interval=0)
    assert [path.name for path in outputs.image_filenames] == [f"{index}.png" for index in range(8)]


def test_splits_and_seed_points_of_windows(tmp_path):
    (tmp_path / "points").mkdir()
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "points/a b.ply").write_text(f"{header}end_header\n0 0 0\n")
    train, test = [f"images\\v{i:02d}.png" for i in range(2, 9)], ["./images/v00", "C:\\scene\\images\\v01.png"]
    write_transforms(tmp_path, train_filenames=train, test_filenames=test[:1], ply_file_path=".\\points\\a b.ply")
    outputs = parse(tmp_path, "test")
    assert names(outputs) == ["v00"] and not outputs.metadata["points3D_random"]


# --- the text of transforms.json ----------------------------------------------------------------------------------


def commented(text: str) -> str:
    text = text.replace('"fl_x"', '// focal length\n/* of\nthe lens, "fl" */ "fl_x"').replace("}]", "},\n# done\n]")
    return text.replace('"camera_model"', '"url": "http://a/b//c, ]", "camera_model"')


TEXTS = {
    "a byte order mark": lambda text: text.encode("utf-8-sig"),
    "UTF-16 of Windows": lambda text: text.encode("utf-16"),
    "comments and a last comma": lambda text: commented(text).encode(),
    "nan and inf as C prints them": lambda text: text.replace(
        '"frames"', '"sharp": -nan(ind), "aabb": [nan, inf, -Infinity, -1.#INF, 1.#QNAN], "frames"'
    ).encode(),
    "numbers as text, and null": lambda text: text.replace(f"{FX},", f'"{FX}", "k1": null,').encode(),
}


@pytest.mark.parametrize("form", TEXTS)
def test_json_as_programs_write_it(tmp_path, form):
    write_transforms(tmp_path)
    changed = TEXTS[form]((tmp_path / "transforms.json").read_text())
    (tmp_path / "transforms.json").write_bytes(changed)
    outputs = parse(tmp_path, eval_interval=0)
    assert names(outputs) == ALL
    assert camera_from_nerfstudio(outputs.cameras, 0).K[0, 0] == FX


@pytest.mark.parametrize("word", ["nan", "NaN", '"NaN"', "-inf", "Infinity"])
def test_no_number_is_called_by_its_name(tmp_path, word):
    write_transforms(tmp_path)
    text = (tmp_path / "transforms.json").read_text().replace(f'"fl_x": {FX}', f'"fl_x": {word}')
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(UserError, match=r"it has fl_x = '?(nan|NaN|-inf|inf)'?, which is no finite number"):
        parse(tmp_path)


# --- photos that are missing --------------------------------------------------------------------------------------


@pytest.mark.parametrize("write", [write_transforms, write_colmap])
def test_missing_photos_are_counted_and_left_out(tmp_path, write, capsys):
    write(tmp_path)
    full = parse(tmp_path, eval_interval=0)
    capsys.readouterr()
    for index in (1, 3, 4, 7):
        (tmp_path / f"images/v{index:02d}.png").unlink()
    outputs = parse(tmp_path, eval_interval=0)
    assert names(outputs) == ["v00", "v02", "v05", "v06", "v08"]
    assert outputs.cameras.camera_to_worlds.equal(full.cameras.camera_to_worlds[[0, 2, 5, 6, 8]])  # the same world
    said = capsys.readouterr().out
    assert "4 of the 9 photos that" in said and f"the first of them {tmp_path}/images/v01.png" in said
    assert "they are left out (beags-data --strict True refuses instead)" in said
    with pytest.raises(UserError, match="4 of the 9 photos that .* are missing, the first of them .*v01.png: restore"):
        parse(tmp_path, strict=True)
    (tmp_path / "images/v08.png").unlink()
    with pytest.raises(UserError, match="5 of the 9 photos that .* are missing"):
        parse(tmp_path)
    shutil.rmtree(tmp_path / "images")
    with pytest.raises(UserError, match="all of the 9 photos that .* are missing"):
        parse(tmp_path)


@pytest.mark.parametrize("write", [write_transforms, write_colmap])
def test_photos_that_are_to_be_left_out_are_not_used_and_the_rest_stays(tmp_path, write):
    write(tmp_path)
    full, outputs = parse(tmp_path), parse(tmp_path, leave_out=("v04", "v01"))
    assert names(full) == ALL[1:8] and names(outputs) == ["v02", "v03", "v05", "v06", "v07"]
    assert outputs.cameras.camera_to_worlds.equal(full.cameras.camera_to_worlds[[1, 2, 4, 5, 6]])  # the same world
    assert names(parse(tmp_path, "test", leave_out=("v04", "v01"))) == ["v00", "v08"], "no others are held out"
    assert names(parse(tmp_path, "test", leave_out=("v00",))) == ["v08"]
    with pytest.raises(UserError, match="leave_out names v4, but no image in .* is called that"):
        parse(tmp_path, leave_out=("v4",))
    with pytest.raises(UserError, match="leave_out leaves no image for train: name fewer"):
        parse(tmp_path, leave_out=tuple(ALL[1:8]))


def test_a_missing_photo_leaves_its_split(tmp_path):
    split = {"train_filenames": [f"images/v{i:02d}.png" for i in range(7)], "test_filenames": ["images/v07.png"]}
    write_transforms(tmp_path, **split)
    (tmp_path / "images/v02.png").unlink()
    assert names(parse(tmp_path)) == ["v00", "v01", "v03", "v04", "v05", "v06"]
    (tmp_path / "images/v07.png").unlink()
    with pytest.raises(UserError, match="names splits but no views for test"):
        parse(tmp_path, "test")


# --- cameras ------------------------------------------------------------------------------------------------------

ANGLE_X, ANGLE_Y = 2 * math.atan(WIDTH / 2 / FX), 2 * math.atan(HEIGHT / 2 / FY)
CAMERAS = {
    "angle_x alone": (dict(camera_angle_x=ANGLE_X), [FX, FX, WIDTH / 2, HEIGHT / 2]),
    "angle_y alone": (dict(camera_angle_y=ANGLE_Y), [FY, FY, WIDTH / 2, HEIGHT / 2]),
    "both angles": (dict(camera_angle_x=ANGLE_X, camera_angle_y=ANGLE_Y, cx=CX, cy=CY), [FX, FY, CX, CY]),
    "degrees": (dict(x_fov=math.degrees(ANGLE_X), w=WIDTH, h=HEIGHT), [FX, FX, WIDTH / 2, HEIGHT / 2]),
    "one focal length": (dict(fl_x=FX, w=WIDTH, h=HEIGHT), [FX, FX, WIDTH / 2, HEIGHT / 2]),
    "the other focal length": (dict(fl_y=FY, w=WIDTH, h=HEIGHT), [FY, FY, WIDTH / 2, HEIGHT / 2]),
    "a focal length and an angle": (dict(fl_x=FX, camera_angle_y=ANGLE_Y, w=WIDTH), [FX, FY, WIDTH / 2, HEIGHT / 2]),
    "both, of which pixels count": (dict(fl_x=FX, fl_y=FY, camera_angle_x=1.0), [FX, FY, WIDTH / 2, HEIGHT / 2]),
    "names of ARKit's programs": (dict(fx=FX, fy=FY, cx=CX, cy=CY, width=WIDTH, height=HEIGHT), [FX, FY, CX, CY]),
}


@pytest.mark.parametrize("where", ["file", "frames"])
@pytest.mark.parametrize("form", CAMERAS)
def test_cameras_of_every_dialect(tmp_path, form, where):
    write_transforms(tmp_path)
    given, (fx, fy, cx, cy) = CAMERAS[form]

    def change(meta):
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"):
            del meta[key]
        for entries in [meta] if where == "file" else meta["frames"]:
            entries.update(given)

    edit(tmp_path, change)
    outputs = parse(tmp_path, eval_interval=0)
    for index in range(9):
        camera = camera_from_nerfstudio(outputs.cameras, index)
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        np.testing.assert_allclose(camera.K.numpy(), [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], rtol=1e-6)


def test_frames_may_give_a_part_of_their_cameras(tmp_path):
    write_transforms(tmp_path, k1=0.01)

    def change(meta):
        meta["frames"].sort(key=lambda frame: frame["file_path"])
        meta["frames"][1].update(fl_x=2 * FX)  # its pixels are those of the file
        meta["frames"][2].update(cx=3.0, k1=0.02)
        meta["frames"][3].update(fl_x=20.0, fl_y=30.0)

    edit(tmp_path, change)
    cameras = parse(tmp_path, eval_interval=0).cameras
    found = [[float(getattr(cameras, name)[i]) for name in ("fx", "fy", "cx", "cy")] for i in range(4)]
    expected = [[FX, FY, CX, CY], [2 * FX, 2 * FY, CX, CY], [FX, FY, 3.0, CY], [20.0, 30.0, CX, CY]]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    np.testing.assert_allclose(cameras.distortion_params[:4, 0], [0.01, 0.01, 0.02, 0.01], rtol=1e-6)


def test_the_fisheye_flag_of_instant_ngp(tmp_path):
    write_transforms(tmp_path)
    edit(tmp_path, lambda meta: (meta.pop("camera_model"), meta.update(is_fisheye=True, k1=0.01)))
    assert parse(tmp_path).cameras.camera_type[0, 0] == 2


def test_matrices_of_three_rows(tmp_path):
    write_transforms(tmp_path)
    edit(tmp_path, lambda meta: [frame["transform_matrix"].pop() for frame in meta["frames"]])
    assert names(parse(tmp_path, eval_interval=0)) == ALL


WRONG = {
    "a lens of another kind": (lambda meta: meta.update(ftheta_p0=0.1), "has an f-theta lens: undistort"),
    "five lens parameters": (lambda meta: meta.update(distortion_params=[0.0] * 5), "distortion_params that are not"),
    "an orientation": (lambda meta: meta.update(orientation_override="left"), "orientation 'left', which is none of"),
    "no split": (lambda meta: meta.update(train_filenames="all"), "train_filenames that are no list of paths"),
    "no shift": (lambda meta: meta.update(applied_transform=[[1, 0], [0, 1]]), "applied_transform that is no matrix"),
}


@pytest.mark.parametrize("mistake", WRONG)
def test_what_no_camera_here_has_is_named(tmp_path, mistake):
    write_transforms(tmp_path)
    change, message = WRONG[mistake]
    edit(tmp_path, change)
    with pytest.raises(UserError, match=message) as raised:
        parse(tmp_path)
    assert "\n" not in str(raised.value)


def test_lenses_that_no_camera_here_has_are_named(tmp_path):
    write_colmap(tmp_path, text=True)
    (tmp_path / "sparse/0/cameras.txt").write_text(f"1 FULL_OPENCV {WIDTH} {HEIGHT} 1 1 1 1 0 0 0 0 0 0 0 0\n")
    with pytest.raises(UserError, match="COLMAP's lens FULL_OPENCV, which is not supported: undistort"):
        parse(tmp_path)


def test_blenders_synthetic_scenes(tmp_path):
    """A file for each split, angles, no sizes, names without suffix."""
    for split, count in (("train", 9), ("test", 3)):
        frames = []
        for index, pose in enumerate(write_transforms(tmp_path / "made", count=count)):
            write_image(tmp_path / split / f"r_{index}.png", noise(index))
            frames.append({"file_path": f"./{split}/r_{index}", "rotation": 0.1, "transform_matrix": pose.tolist()})
        meta = {"camera_angle_x": ANGLE_X, "frames": frames}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(meta))
    shutil.rmtree(tmp_path / "made")
    outputs = parse(tmp_path / "transforms_train.json", eval_interval=0)
    assert names(outputs) == [f"r_{index}" for index in range(9)]
    assert title(tmp_path / "transforms_train.json") == "nerfstudio"


def test_missing_photos_of_a_table_are_known_by_their_numbers(tmp_path, capsys):
    write_llff(tmp_path)
    options = dict(images_path=Path("images_4"), eval_interval=0)
    full = parse(tmp_path, **options)
    files = sorted((tmp_path / "images_4").iterdir())
    capsys.readouterr()
    for index in (2, 5):
        files[index].unlink()
    rest = [index for index in range(len(files)) if index not in (2, 5)]
    outputs = parse(tmp_path, **options)
    assert outputs.image_filenames == [files[index] for index in rest]
    rotations = full.cameras.camera_to_worlds[rest][:, :, :3]
    np.testing.assert_allclose(relative(outputs.cameras.camera_to_worlds), relative(rotations), atol=1e-5)
    assert f"2 of the {len(files)} photos that {tmp_path}/" in capsys.readouterr().out
    with pytest.raises(UserError, match="are missing, the first of them"):
        parse(tmp_path, strict=True, **options)
    files[rest[0]].rename(tmp_path / "images_4/extra.png")
    with pytest.raises(UserError, match="poses but"):
        parse(tmp_path, **options)


def relative(poses) -> np.ndarray:
    """Return the rotations from the first view to the others."""
    rotations = poses[:, :3, :3].double().numpy()
    return rotations[0].T @ rotations
