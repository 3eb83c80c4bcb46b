"""LERF-Mask, 3D-OVS, SPIn-NeRF and DTU from their exact file trees."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from data_folders import CX, CY, HEIGHT, WIDTH, write_image
from layout_folders import ids, opencv_matrices, write_3dovs, write_dtu, write_lerf_mask, write_spin_nerf
from parsed_views import AS_GIVEN, POINT, names, parse, pixel, title

from beags_plugin.data.layouts.dtu import decompose
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.plugin.views.dataset import BeagsDataset
from beags_plugin.system.errors import UserError
from beags_plugin.views.cameras import camera_from_nerfstudio


def test_lerf_mask(tmp_path, capsys):
    stems = write_lerf_mask(tmp_path)
    assert title(tmp_path) == "LERF-Mask"
    outputs, test = parse(tmp_path), parse(tmp_path, "test")
    assert names(test) == ["frame_00041", "frame_00152"] and set(names(outputs)) == set(stems) - set(names(test))
    assert outputs.metadata["classes"] == {0: "background", 37: "class_37"}
    assert (BeagsDataset(outputs).get_data(2)["labels"].numpy() == ids(37)).all()
    assert test.metadata["mask_filenames"] == [None, None]
    truth, folder = test.metadata["ground_truth"]["visible"], tmp_path / "test_mask"
    assert truth == {
        "green apple": [folder / "0/green apple.png", folder / "1/green apple.png"],
        "old camera": [folder / "0/old camera.png", None],
    }
    said = " ".join(capsys.readouterr().out.split())
    assert "Exact masks of 'green apple', 'old camera' do not count" in said
    assert "The images of images are used as they are, as in the paper (other sizes: " in said
    (tmp_path / "classes.json").write_text('{"37": "green apple", "4": "old camera"}')
    assert parse(tmp_path).metadata["classes"][37] == "green apple"
    assert "do not count" not in capsys.readouterr().out


def test_prompts_of_lerf_mask_are_scored_by_class_name(tmp_path):
    """A run with the classes cup and box, of which the second test view alone has a mask of the cup.

    The first has its own black object_mask, as in the data set: it is no truth.
    """
    from run_folders import write_trained

    from beags_plugin.objects.evaluate import EvaluatedRun, evaluate_run

    write_lerf_mask(tmp_path / "figurines")
    write_image(tmp_path / "figurines/test_mask/1/cup.png", 255 * ids())
    write_image(tmp_path / "figurines/object_mask/frame_00041.png", ids(0))
    config = write_trained(tmp_path / "run", tmp_path / "figurines")
    first, second = EvaluatedRun(config).views
    assert first.visible_objects is None and first.visible is None
    assert second.visible_objects is not None and list(second.visible_objects) == [1]
    assert (second.visible_objects[1].numpy() == (ids() > 0)).all()
    scored = {(mask.kind, mask.class_id, mask.view) for mask in evaluate_run(config).after.masks}
    assert scored == {("extracted", 1, 1), ("rendered", 1, 1)}


def test_the_masks_of_dtu_train_and_evaluate(tmp_path):
    """Three-channel masks as class maps of a data manager, and as silhouettes of the class called object."""
    from beags_plugin.plugin.views.datamanager import BeagsDataManagerConfig
    from beags_plugin.views.held_out_views import HeldOutViews

    write_dtu(tmp_path)
    manager = BeagsDataManagerConfig(dataparser=BeagsDataParserConfig(data=tmp_path)).setup(device="cpu")
    views = HeldOutViews(manager, {0: "background", 1: "object"}, torch.zeros(3))
    labels = views.manager.views("train")[2].labels
    assert labels is not None and (labels.numpy() == ids()).all()
    view = views[1]
    assert view.visible is not None and (view.visible.numpy() == ids()).all()
    assert view.silhouettes is not None and (view.silhouettes[1].numpy() == (ids() > 0)).all()


def test_3dovs(tmp_path, capsys):
    stems = write_3dovs(tmp_path)
    assert title(tmp_path) == "3D-OVS"
    test = parse(tmp_path, "test")
    assert names(test) == ["00", "04"] and names(parse(tmp_path)) == [stems[i] for i in (1, 2, 3, 5)]
    said = " ".join(capsys.readouterr().out.split())
    assert "The images of images are used as they are, 20 pixels wide, narrower than the paper's 1600 (" in said
    assert test.metadata["classes"] == {0: "background", 1: "red bag", 2: "banana", 3: "white sheet"}
    assert test.metadata["ground_truth"]["visible"]["banana"] == [
        tmp_path / f"segmentations/{view}/banana.png" for view in ("00", "04")
    ]
    write_image(tmp_path / "masks/01.png", ids(4))
    with pytest.raises(UserError, match=r"holds id 4, which .*classes\.txt does not name"):
        parse(tmp_path)
    write_image(tmp_path / "masks/01.png", ids(2))
    assert (BeagsDataset(parse(tmp_path)).get_data(0)["labels"].numpy() == ids(2)).all()


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
    assert (BeagsDataset(outputs).get_data(0)["labels"].numpy() == ids(1, WIDTH // 4, HEIGHT // 4)).all()


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
    assert outputs.metadata["mask_filenames"][4] == tmp_path / "mask/004.png"
    assert (BeagsDataset(outputs).get_data(4)["labels"].numpy() == ids()).all()
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
