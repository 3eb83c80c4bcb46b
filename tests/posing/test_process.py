"""Photos of a known scene go through ``beags process``: poses, files, notes, and what it keeps."""

from __future__ import annotations

import json
import shutil
import threading

import numpy as np
import pytest

pycolmap = pytest.importorskip("pycolmap")
from data_folders import noise, write_image
from photographed_corner import camera, errors, frames, photograph, quiet, write_photos
from PIL import Image

from beags_plugin.commands.cli import main
from beags_plugin.posing import features, mapping
from beags_plugin.posing.features import _features as find_features
from beags_plugin.posing.files import MODEL
from beags_plugin.posing.mapping import color_points
from beags_plugin.posing.photos import Photo
from beags_plugin.posing.process import REPORT, process
from beags_plugin.system.reading.ply import read_ply_points


@pytest.fixture(scope="module", autouse=True)
def few_features():
    """Find fewer features in each photo: matching them takes most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(features, "MOST", 1000)
        yield


@pytest.fixture(scope="module")
def posed(few_features, tmp_path_factory):
    """Return the folder of a scene made by the command from twelve photos, and the true poses."""
    root = tmp_path_factory.mktemp("posed")
    given = write_photos(root / "photos", prefix="walk 1, ")  # phones give such names
    main(["process", "--data", str(root / "photos"), "--output-dir", str(root / "scene")])
    return root / "scene", given


def test_poses_are_those_of_the_cameras(posed):
    folder, given = posed
    found = frames(folder)
    assert found.keys() == given.keys()
    turned, moved = errors(found, given)
    assert np.median(turned) < 0.3 and np.median(moved) < 0.005
    meta = json.loads((folder / "transforms.json").read_text())
    assert meta["fl_x"] == pytest.approx(300, rel=0.02) and (meta["w"], meta["h"]) == (320, 240)


def test_points_lie_before_the_cameras_of_the_same_file(posed):
    folder, _ = posed
    points, colors = read_ply_points(folder / "sparse_pc.ply")
    assert len(points) > 300 and colors.std() > 10
    for pose in frames(folder).values():
        depth = -(points - pose[:3, 3]) @ pose[:3, 2]
        assert np.mean(depth > 0) > 0.95
    assert pycolmap.Reconstruction(folder / MODEL).num_points3D() == len(points)
    report = json.loads((folder / REPORT).read_text())
    assert (report["registered"], report["photos"], report["notes"]) == (12, 12, [])
    assert Image.open(folder / "poses.png").size[0] == 1200


def test_points_have_the_colours_that_colmap_gives_them(posed):
    folder, _ = posed
    model = pycolmap.Reconstruction(folder / MODEL)
    ours = {key: point.color.astype(int) for key, point in model.points3D.items()}
    model.extract_colors_for_all_images(folder / "images")
    assert max(np.abs(ours[key] - point.color).max() for key, point in model.points3D.items()) <= 1


def test_a_photo_without_points_gives_no_colours(posed):
    folder, _ = posed
    model = pycolmap.Reconstruction(folder / MODEL)
    image = model.images[model.reg_image_ids()[0]]
    for index, point in enumerate(image.points2D):
        if point.has_point3D():
            model.delete_observation(image.image_id, index)
    color_points(model, folder / "images")
    assert np.std([point.color for point in model.points3D.values()]) > 10


def test_features_of_a_photo_that_is_decoded_smaller_lie_where_they_are_in_it(tmp_path, monkeypatch):
    monkeypatch.setattr(features, "LARGEST", 320)
    large = Image.fromarray(photograph(camera(0.6))).resize((1280, 960), Image.Resampling.BICUBIC)
    points = []
    for name in ("a.jpg", "a.png"):
        large.save(tmp_path / name, quality=95)
        photo = Photo(tmp_path / name, tmp_path / name, 1280, 960, False, None, name)
        with pycolmap.Database.open(tmp_path / f"{name}.db") as database:
            features.add_features(database, [photo], lambda done, total: None)
            points.append(database.read_keypoints(1)[:, :2])
    offsets = points[0][:, None] - points[1]
    nearest = offsets[np.arange(len(offsets)), np.square(offsets).sum(2).argmin(1)]
    near = np.linalg.norm(nearest, axis=1) < 0.5
    assert len(points[0]) > 100 and near.mean() > 0.8 and np.abs(np.median(nearest[near], axis=0)).max() < 0.07


def test_photos_that_are_reduced_get_the_lens_and_the_points_of_their_own_size(tmp_path, monkeypatch):
    monkeypatch.setattr(features, "LARGEST", 321)
    given = write_photos(tmp_path / "photos", enlarged=2)
    process(tmp_path / "photos", tmp_path / "scene", quiet)
    turned, _ = errors(frames(tmp_path / "scene"), given)
    meta = json.loads((tmp_path / "scene/transforms.json").read_text())
    assert np.median(turned) < 0.3 and (meta["w"], meta["h"]) == (640, 480)
    assert [meta["fl_x"], meta["fl_y"]] == pytest.approx([600, 600], rel=0.02)
    model = pycolmap.Reconstruction(tmp_path / "scene" / MODEL)
    monkeypatch.setattr(mapping, "LARGEST", 160)
    for photo in (tmp_path / "scene/images").iterdir():
        Image.open(photo).save(photo, "JPEG", quality=95)  # now it is decoded at a quarter of its size
    color_points(model, tmp_path / "scene/images")
    colors = [point.color.astype(int) for point in model.points3D.values()]
    model.extract_colors_for_all_images(tmp_path / "scene/images")
    theirs = [point.color.astype(int) for point in model.points3D.values()]
    assert 0 < np.abs(np.subtract(colors, theirs)).mean() < 0.3 * np.std(theirs)
    image = next(iter(model.images.values()))
    seen = [(point.xy, model.points3D[point.point3D_id].xyz) for point in image.points2D if point.has_point3D()]
    off = [np.linalg.norm(image.project_point(xyz) - xy) for xy, xyz in seen]
    assert max(point[0] for point, _ in seen) > 400 and np.median(off) < 1.5


def test_ns_train_reads_the_scene(posed):
    pytest.importorskip("nerfstudio")
    from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig

    parser = BeagsDataParserConfig(data=posed[0]).setup()
    outputs = parser.get_dataparser_outputs("train")
    assert len(outputs.image_filenames) == 10  # every eighth is held out
    assert len(outputs.metadata["points3D_xyz"]) == len(read_ply_points(posed[0] / "sparse_pc.ply")[0])


def test_a_second_call_computes_nothing_and_another_only_what_is_new(posed, tmp_path, monkeypatch):
    """Photos may be added anywhere in their order, changed under their names, and left out."""
    folder, given = tmp_path / "scene", dict(posed[1])
    shutil.copytree(posed[0], folder)
    before = (folder / "transforms.json").read_bytes()
    computed = []
    monkeypatch.setattr(features, "_features", lambda *args: computed.append(1) or find_features(*args))
    process(folder / "images", folder, quiet)
    assert (folder / "transforms.json").read_bytes() == before and not computed
    (folder / REPORT).unlink()  # a call that was cut off at its very end leaves no report
    given |= {"a": camera(0.75, 2.0), "walk 1, 03": camera(0.5, 2.2)}
    for name in ("a", "walk 1, 03"):
        Image.fromarray(photograph(given[name])).save(folder / f"images/{name}.png")
    (folder / "images/walk 1, 05.png").unlink()
    del given["walk 1, 05"]
    report, _ = process(folder / "images", folder, quiet)
    assert len(computed) == 2 and report.cameras == 1
    found = frames(folder)
    assert found.keys() == given.keys()
    assert errors(found, given)[0].max() < 0.5


def test_a_call_that_was_cut_off_goes_on_to_the_same_poses(posed, tmp_path, monkeypatch):
    photos, folder, computed = posed[0].parent / "photos", tmp_path / "scene", []
    one_at_a_time = threading.Lock()

    def counting(*args):
        with one_at_a_time:
            computed.append(1)
            if len(computed) == 6:
                raise KeyboardInterrupt
        return find_features(*args)

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(features, "_features", counting)
    monkeypatch.setattr("beags_plugin.posing.process.match", stop)
    for _ in range(2):  # stops at the sixth photo, and before the matches
        with pytest.raises(KeyboardInterrupt):
            process(photos, folder, quiet)
    monkeypatch.undo()
    monkeypatch.setattr(features, "_features", lambda *_: pytest.fail("computed again"))
    monkeypatch.setattr("beags_plugin.posing.process.likeness", lambda *_: pytest.fail("chosen again"))
    process(photos, folder, quiet)
    assert 13 <= len(computed) <= 12 + features.AHEAD  # the sixth twice, perhaps those that were read ahead too
    assert (folder / "transforms.json").read_bytes() == (posed[0] / "transforms.json").read_bytes()


def test_photos_that_fit_nowhere_are_named_and_sizes_counted(tmp_path):
    photos = tmp_path / "photos"
    write_photos(photos, 7)
    for index in range(3):
        write_image(photos / f"x{index}.png", noise(index, 60, 80 + 10 * index))
    report, _ = process(photos, tmp_path / "scene", quiet)
    assert (report.registered, report.without_pose) == (7, ["x0.png", "x1.png", "x2.png"])
    said = "\n".join(report.notes)
    assert "have 4 sizes (60x80, 60x90, 60x100, 320x240)" in said
    assert "x0.png, x1.png, x2.png have no pose" in said


@pytest.mark.slow("finds poses of photos made for it")
def test_groups_blur_repeats_and_kinds_of_photos_get_a_sentence_each(tmp_path):
    photos = tmp_path / "photos"
    write_photos(photos, 9, "a")
    write_photos(photos, 6, "b", seed=7)
    write_photos(photos, 7, "p", turned=True)
    blurred = np.asarray(Image.open(photos / "a04.png").reduce(10).resize((320, 240)))
    Image.fromarray(blurred).save(photos / "a04x.png")
    shutil.copy(photos / "a02.png", photos / "a02x.png")
    report, _ = process(photos, tmp_path / "scene", quiet)
    said = "\n".join(report.notes)
    assert "a04x.png looks blurred" in said and "a02x.png shows the same" in said
    assert "portrait" in said and report.cameras == 2
    assert "groups of" in said and report.groups[1] == 6
    lenses = [frame["w"] for frame in json.loads((tmp_path / "scene/transforms.json").read_text())["frames"]]
    assert sorted(set(lenses)) == [240, 320]


@pytest.mark.slow("finds poses of photos made for it")
def test_the_middle_of_a_lens_is_found_where_it_is_far_from_that_of_the_photo(tmp_path):
    given = write_photos(tmp_path / "photos", 14, shift=(14.0, -9.0))
    process(tmp_path / "photos", tmp_path / "scene", quiet)
    turned, _ = errors(frames(tmp_path / "scene"), given)
    assert np.median(turned) < 0.4  # 14 pixels are 2.7 degrees


@pytest.mark.slow("finds poses of photos made for it")
def test_on_a_turntable_masks_find_the_poses_of_what_turns(tmp_path, capsys):
    """A room that stands before the camera fills most of each photo; the masks lie where training finds them."""
    photos, scene = tmp_path / "photos", tmp_path / "scene"
    given = write_photos(photos)
    room = photograph(camera(0.8), seed=5)
    inside = np.zeros(room.shape[:2], np.uint8)
    inside[20:220, 60:260] = 1
    for name in given:
        photo = np.where(inside[..., None] == 1, np.asarray(Image.open(photos / f"{name}.png")), room)
        write_image(photos / f"{name}.png", photo)
        write_image(scene / f"masks/{name}.png", np.where(inside == 1, 1, 255).astype(np.uint8))
    arguments = ["process", "--data", str(photos), "--output-dir", str(scene)]
    with pytest.raises(SystemExit):  # most features say that no camera moved
        main(arguments)
    main([*arguments, "--masks", str(scene / "masks"), "--ignore-ids", "255"])
    assert "--pipeline.datamanager.photos objects beags-data --ignore-ids 255" in " ".join(
        capsys.readouterr().out.split()
    )
    found = frames(scene)
    assert found.keys() == given.keys() and np.median(errors(found, given)[0]) < 0.5


@pytest.mark.parametrize("options", [["--ignore-ids", "255"], ["--masks", "masks", "--ignore-ids", "70000"]])
def test_ids_that_mean_nothing_are_refused(tmp_path, monkeypatch, options, capsys):
    monkeypatch.chdir(tmp_path)
    write_photos(tmp_path / "photos", 3)
    (tmp_path / "masks").mkdir()
    with pytest.raises(SystemExit):
        main(["process", "--data", "photos", "--output-dir", "scene", *options])
    assert "ignore_ids" in capsys.readouterr().out and not (tmp_path / "scene").exists()
