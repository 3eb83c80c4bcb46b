"""LERF-Mask and 3D-OVS from their exact file trees."""

from __future__ import annotations

import pytest
from data_folders import write_image
from layout_folders import ids, write_3dovs, write_lerf_mask
from parsed_views import names, parse, title

from beags_plugin.plugin.views.dataset import BeagsDataset
from beags_plugin.system.errors import UserError


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
    assert "The images of images are used 20 pixels wide (other sizes: " in said
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


def test_3dovs(tmp_path, capsys):
    stems = write_3dovs(tmp_path)
    assert title(tmp_path) == "3D-OVS"
    test = parse(tmp_path, "test")
    assert names(test) == ["00", "04"] and names(parse(tmp_path)) == [stems[i] for i in (1, 2, 3, 5)]
    said = " ".join(capsys.readouterr().out.split())
    assert "The images of images are used 20 pixels wide (" in said
    assert test.metadata["classes"] == {0: "background", 1: "red bag", 2: "banana", 3: "white sheet"}
    assert test.metadata["ground_truth"]["visible"]["banana"] == [
        tmp_path / f"segmentations/{view}/banana.png" for view in ("00", "04")
    ]
    write_image(tmp_path / "masks/01.png", ids(4))
    with pytest.raises(UserError, match=r"holds id 4, which .*classes\.txt does not name"):
        parse(tmp_path)
    write_image(tmp_path / "masks/01.png", ids(2))
    assert (BeagsDataset(parse(tmp_path)).get_data(0)["labels"].numpy() == ids(2)).all()
