"""Close-ups of objects: where they are, what they show, and which of them a step sees."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio")

from data_folders import noise, write_image, write_transforms
from distorted_views import manager, write_distorted

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.system.errors import UserError
from beags_plugin.views.close_ups import DETAIL, fitted
from beags_plugin.views.focus import LEAST_SIDE

RAYS = [(0.1, 0.1), (-0.25, 0.05)]


def write_objects(root, *boxes, views=9, size=(160, 120)) -> None:
    """Write a scene of noise whose objects 1, 2, .. are boxes (left, top, right, bottom) in every view."""
    width, height = size
    write_transforms(root, views, w=width, h=height, fl_x=140.0, fl_y=140.0, cx=width / 2, cy=height / 2)
    ids = np.zeros((height, width), np.uint8)
    for number, (left, top, right, bottom) in enumerate(boxes, 1):
        ids[top:bottom, left:right] = number
    for index in range(views):
        write_image(root / f"images/v{index:02d}.png", noise(index, width, height))
        write_image(root / f"masks/v{index:02d}.png", ids)
    names = {str(number): f"thing {number}" for number in range(1, len(boxes) + 1)}
    (root / "classes.json").write_text(json.dumps({"0": "background", **names}))


def focused(root, focus: object = "auto", downscale=4.0, **options):
    data = manager(root, {"downscale_factor": downscale}, focus=str(focus), **{"begins": True, **options})
    data.focus()
    return data


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_a_close_up_shows_what_its_camera_sees(tmp_path, model):
    """Each disc lies where the formulas of the lens put its ray, in photo and labels, however it is shrunk and cut."""
    write_distorted(tmp_path, model, RAYS)
    data = focused(tmp_path, 1.0, 7.0)
    photo = next(index for index, view in enumerate(data.views("train")) if view.name == "v01")
    sizes, seen = set(), 0
    for step in range(60):
        camera, batch = data.close_ups.drawn(photo, step)
        image, labels = batch["image"].numpy(), batch["labels"].numpy()
        assert image.shape[:2] == labels.shape == (camera.height, camera.width)
        sizes.add(float(camera.K[0, 0]))
        rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
        for number, ray in enumerate(RAYS, 1):
            inside = labels == number
            x, y, _ = (camera.K.double() @ torch.tensor([*ray, 1.0], dtype=torch.float64)).tolist()
            scale = float(camera.K[0, 0]) / 110.0
            if not (7 * scale < x < camera.width - 7 * scale and 7 * scale < y < camera.height - 7 * scale):
                continue  # the window cuts the disc, or does not show it
            seen += 1
            assert abs(columns[inside].mean() - x) < 0.5 and abs(rows[inside].mean() - y) < 0.5
            weights = image[..., 0] * ((columns - x) ** 2 + (rows - y) ** 2 < (9 * scale) ** 2)
            assert abs((columns * weights).sum() / weights.sum() - x) < 0.5
            assert abs((rows * weights).sum() / weights.sum() - y) < 0.5
    assert seen > 10 and len(sizes) > 1


def test_a_step_sees_the_same_in_every_run_and_others_see_other_windows(tmp_path):
    write_objects(tmp_path, (40, 30, 110, 90))
    one, other = (focused(tmp_path, 0.5) for _ in range(2))
    drawn = [one.close_ups.drawn(0, step) for step in range(200)]
    found = [each for each in drawn if each is not None]
    assert 70 < len(found) < 130
    for step in (0, 7, 150):  # a resumed run asks in any order
        first, second = drawn[step], other.close_ups.drawn(0, step)
        assert (first is None) == (second is None)
        if first is not None:
            assert torch.equal(first[0].K, second[0].K) and torch.equal(first[1]["image"], second[1]["image"])
    assert len({tuple(camera.K.flatten().tolist()) for camera, _ in found}) > 20
    seed = focused(tmp_path, 0.5, train_cameras_sampling_seed=7).close_ups
    assert [seed.drawn(0, step) is None for step in range(200)] != [each is None for each in drawn]


def test_no_step_sees_more_pixels_than_a_whole_photo_has(tmp_path):
    write_objects(tmp_path, (30, 20, 130, 100))
    data = focused(tmp_path, 1.0)
    bound = data.train_dataset.cameras
    bound = int(bound.width[0] * bound.height[0])
    for step in range(20):
        camera, _ = data.close_ups.drawn(step % 7, step)
        assert camera.width * camera.height <= 1.1 * bound
    for close_up in data.close_ups.close_ups:
        assert close_up.camera.width * close_up.camera.height <= 1.1 * DETAIL * bound


def test_training_sees_both(tmp_path):
    write_objects(tmp_path, (40, 30, 80, 60))
    data = focused(tmp_path, 0.5)
    sizes = set()
    for step in range(40):
        camera, batch = data.next_train(step)
        own = camera.metadata["camera"]
        assert batch["image"].shape[:2] == batch["labels"].shape == (own.height, own.width)
        assert (int(camera.width), int(camera.height)) == (own.width, own.height)
        assert torch.equal(camera.get_intrinsics_matrices()[0], own.K)
        assert torch.equal(own.viewmat, data.views("train")[camera.metadata["cam_idx"]].camera.viewmat)
        sizes.add((own.width, own.height))
    assert (40, 30) in sizes and len(sizes) > 1


def test_off_is_as_without(tmp_path):
    write_objects(tmp_path, (40, 30, 80, 60))
    data, plain = focused(tmp_path, "off"), manager(tmp_path, {"downscale_factor": 4.0}, focus="off")
    assert data.close_ups is None and data.close_up_views() == []
    for step in range(10):
        (camera, batch), (other, its) = data.next_train(step), plain.next_train(step)
        assert torch.equal(batch["image"], its["image"]) and torch.equal(camera.fx, other.fx)


@pytest.mark.parametrize(
    ("box", "downscale", "on", "line"),
    [((40, 30, 100, 90), 4.0, True, "Objects cover 18.8% of the photos that show them: 50% of the steps see close-ups"),
     ((10, 10, 150, 110), 4.0, False, "Objects cover 73% of the photos that show them: training sees whole photos"),
     ((40, 30, 100, 90), 1.0, False, ""),  # photos have no more to show
     ((0, 0, 0, 0), 4.0, False, "")],
)  # fmt: skip
def test_auto_looks_at_what_objects_cover_and_what_they_would_gain(tmp_path, capsys, box, downscale, on, line):
    write_objects(tmp_path, box)
    assert (focused(tmp_path, "auto", downscale).close_ups is not None) == on
    assert line in capsys.readouterr().out.replace("\n", " ")


@pytest.mark.parametrize("side", [1, 2])
@pytest.mark.parametrize("others", [(), ((40, 30, 80, 60),)])
def test_an_object_smaller_than_a_pixel_is_named(tmp_path, capsys, side, others):
    write_objects(tmp_path, *others, (23, 23, 23 + side, 23 + side))
    assert (focused(tmp_path).close_ups is not None) == bool(others)
    said = capsys.readouterr().out.replace("\n", " ")
    small = len(others) + 1
    assert f"No photo shows thing {small} at the size of the training" in said and "--downscale-factor" in said
    assert f"thing {small}, thing" not in said and f", thing {small}" not in said


def test_an_object_that_its_masks_do_not_hold_either_is_not_named(tmp_path, capsys):
    write_objects(tmp_path, (40, 30, 80, 60), (0, 0, 0, 0))
    assert focused(tmp_path).close_ups is not None
    assert "No photo shows" not in capsys.readouterr().out.replace("\n", " ")


def test_photos_without_objects_do_not_make_objects_small(tmp_path, capsys):
    """A third of the photos shows an object that fills them."""
    write_objects(tmp_path, (5, 5, 155, 115))
    for name in ("v01", "v02", "v04", "v05", "v07"):
        write_image(tmp_path / f"masks/{name}.png", np.zeros((120, 160), np.uint8))
    assert focused(tmp_path).close_ups is None
    assert "Objects cover 89% of the photos that show them" in capsys.readouterr().out.replace("\n", " ")


def test_a_share_without_objects_is_off_and_says_so(tmp_path, capsys):
    write_objects(tmp_path)
    assert focused(tmp_path, 0.3).close_ups is None
    assert "focus is off" in capsys.readouterr().out


def test_objects_that_stand_close_share_a_close_up(tmp_path):
    write_objects(tmp_path, (40, 40, 60, 60), (64, 42, 80, 60))
    assert len(focused(tmp_path).close_ups.close_ups) == 7
    write_objects(tmp_path, (10, 10, 30, 30), (120, 80, 150, 110))
    close_ups = focused(tmp_path).close_ups
    assert len(close_ups.close_ups) == 14 and len(set(close_ups.names)) == 14
    assert {tuple(np.unique(view.labels).tolist()) for view in close_ups.views("cpu")} == {(0, 1), (0, 2)}


def test_specks_do_not_widen_a_close_up_and_a_few_pixels_get_one(tmp_path):
    write_objects(tmp_path, (40, 40, 80, 80))
    ids = np.zeros((120, 160), np.uint8)
    ids[40:80, 40:80], ids[2:6, 150:156] = 1, 1
    write_image(tmp_path / "masks/v01.png", ids)
    corner = np.zeros((120, 160), np.uint8)
    corner[:4, 156:] = 1
    write_image(tmp_path / "masks/v02.png", corner)
    data = focused(tmp_path, 1.0)
    by_photo = {each.photo: each.camera for each in data.close_ups.close_ups}
    assert (by_photo[0].width, by_photo[0].height) == (by_photo[2].width, by_photo[2].height)
    assert (by_photo[1].width, by_photo[1].height) == (LEAST_SIDE, LEAST_SIDE)  # it lies in the corner of its photo


def test_a_photo_without_a_mask_gets_one_from_the_others(tmp_path):
    write_objects(tmp_path, (40, 30, 80, 60))
    (tmp_path / "masks/v03.png").unlink()
    data = focused(tmp_path, 1.0)
    photo = [view.name for view in data.views("train")].index("v03")
    assert data.close_ups.drawn(photo, 0) is None and len(data.close_ups.close_ups) == 6
    views = data.close_up_views()
    voted = [
        view.labels if view.labels is not None else torch.zeros(30, 40, dtype=torch.int32)
        for view in data.views("train")
    ]
    voted[photo][10:20, 5:15] = 1
    data.replace_labels(voted, [view.labels for view in views])  # reprojection has found the object there
    camera, batch = data.close_ups.drawn(photo, 0)
    assert len(data.close_ups.close_ups) == 7 and batch["labels"].shape == (camera.height, camera.width)
    assert 0.3 < float((batch["labels"] == 1).float().mean()) < 0.9


def test_other_labels_take_the_place_of_the_masks(tmp_path):
    write_objects(tmp_path, (40, 30, 80, 60))
    data = focused(tmp_path, 1.0)
    views = data.close_up_views()
    new = [torch.full((view.camera.height, view.camera.width), 5, dtype=torch.int32) for view in views]
    new[0][:, :10] = IGNORE
    data.replace_labels([torch.zeros(30, 40, dtype=torch.int32)] * 7, new)
    for step in range(8):
        _, batch = data.next_train(step)
        assert batch["present"] == [5] and set(batch["labels"].unique().tolist()) <= {5, IGNORE}
    assert torch.equal(data.close_up_views()[0].labels, new[0])


def test_auto_keeps_close_ups_within_a_bound_of_memory(tmp_path, monkeypatch, capsys):
    write_objects(tmp_path, (40, 30, 80, 60))
    monkeypatch.setattr("beags_plugin.views.focus.MOST_BYTES", 10_000)
    assert focused(tmp_path, "auto").close_ups is None
    assert "GB: focus is off" in capsys.readouterr().out.replace("\n", " ")


def test_auto_leaves_a_scene_alone_that_others_have_begun(tmp_path):
    write_objects(tmp_path, (40, 30, 80, 60))
    assert focused(tmp_path, "auto", begins=False).close_ups is None
    assert focused(tmp_path, 0.5, begins=False).close_ups is not None


@pytest.mark.parametrize("focus", [1.5, -0.1, "on", float("nan")])
def test_wrong_shares_are_refused(tmp_path, focus):
    write_objects(tmp_path, (40, 30, 80, 60))
    with pytest.raises(UserError, match="datamanager.focus is"):
        focused(tmp_path, focus)


def test_sizes_fit():
    assert fitted(400, 300, 12_000) == (126, 95) and fitted(40, 30, 12_000) == (40, 30)
    assert fitted(1, 10_000, 100) == (1, 1000) and fitted(160, 120, 1e9) == (160, 120)
