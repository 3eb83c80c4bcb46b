"""beags masks make, reproject and check: their files, guards and messages."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from data_folders import HEIGHT, WIDTH, write_colmap, write_image, write_transforms
from run_folders import discs, drawn_labels, ring_cameras, write_drawn_scene, write_scene, write_trained
from source_scenes import truth

from beags_plugin.commands.cli import main
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.classes import read_id_mask
from beags_plugin.masks.sources.base import MadeMasks, MaskSource, Progress, SourceScene
from beags_plugin.objects.make_masks import make_masks
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.system.errors import UserError


def test_the_command_writes_masks_that_training_finds(tmp_path, capsys):
    write_transforms(tmp_path)
    for index in range(9):
        write_image(tmp_path / f"objects/cup/v{index:02d}.png", np.uint8(255) * (truth(0) == 1))
    arguments = ["masks", "make", "--data", str(tmp_path), "--source", "object-images", "--options", "folder=objects"]
    main(arguments)
    out = capsys.readouterr().out
    assert "9 masks of 9 views, 1 object, " in out and (tmp_path / "made.png").exists()
    metadata = BeagsDataParserConfig(data=tmp_path).setup().get_dataparser_outputs("train").metadata
    assert metadata["classes"] == {0: "background", 1: "cup"} and all(metadata["mask_filenames"])
    np.testing.assert_array_equal(read_id_mask(tmp_path / "masks/v03.png"), truth(0) == 1)
    extra = tmp_path / "objects"
    for index in range(5, 9):
        (extra / f"cup/v{index:02d}.png").unlink()
    write_image(tmp_path / "masks/other/v08.png", truth(0))
    main([*arguments, "--overwrite"])
    assert "5 masks of 9 views" in capsys.readouterr().out
    assert sorted(path.stem for path in (tmp_path / "masks").rglob("*.png")) == [f"v{i:02d}" for i in range(5)]
    kept = {path: path.read_bytes() for path in (*(tmp_path / "masks").glob("*.png"), tmp_path / "classes.json")}
    write_image(extra / "cup/v04.png", np.zeros((3, 3), np.uint8))  # found out after those before it are made
    with pytest.raises(SystemExit):
        main([*arguments, "--overwrite"])
    write_image(extra / "cup/v04.png", truth(0))
    write_image(extra / "background/v03.png", truth(0))
    with pytest.raises(SystemExit):
        main([*arguments, "--overwrite"])
    assert "the name 'background' to two classes" in " ".join(capsys.readouterr().out.split())
    assert all(path.read_bytes() == content for path, content in kept.items())
    assert not list(tmp_path.glob(".masks_*"))


def test_photos_without_poses_get_masks_for_the_search_of_poses(tmp_path, capsys):
    for index in range(3):
        write_image(tmp_path / f"photos/v{index}.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        write_image(tmp_path / f"objects/cup/v{index}.png", np.uint8(255) * (truth(0) == 1))
    main(
        ["masks", "make", "--data", str(tmp_path / "photos"), "--source", "object-images", "--output", str(tmp_path),
         "--options", f"folder={tmp_path / 'objects'}"]
    )  # fmt: skip
    assert "No photo has a pose yet" in capsys.readouterr().out
    assert not (tmp_path / "masks/no_truth.json").exists()  # masks that were read may be anybody's
    for index in range(3):
        np.testing.assert_array_equal(read_id_mask(tmp_path / f"masks/v{index}.png"), truth(0) == 1)


def test_masks_of_gaussian_grouping_are_trained_on(tmp_path, capsys):
    """The data parser reads the masks that were made of the files of ids."""
    write_colmap(tmp_path)
    own = np.array([0, 37, 112], np.uint8)
    for index in range(9):
        ids = own[truth(index % 4)]
        ids[11, 0] = 200 if index < 2 else 0
        write_image(tmp_path / f"object_mask/v{index:02d}.png", ids)
    folder = tmp_path / "made"
    main(["masks", "make", "--data", str(tmp_path), "--source", "gaussian-grouping", "--output", str(folder)])
    out = capsys.readouterr().out
    assert "9 masks of 9 views" in out and "1 id in fewer than 3 views" in out
    config = BeagsDataParserConfig(data=tmp_path, masks_path=folder / "masks", classes_path=folder / "classes.json")
    metadata = config.setup().get_dataparser_outputs("train").metadata
    assert len(metadata["classes"]) == 3 and len(metadata["mask_filenames"]) == 7
    pairs = set()
    for path in metadata["mask_filenames"]:
        exact = truth(int(path.stem[1:]) % 4)
        pairs |= set(zip(read_id_mask(path).ravel().tolist(), exact.ravel().tolist(), strict=True))
    assert pairs == {(0, 0), (37, 1), (112, 2)}


@dataclass(frozen=True)
class Scripted(MaskSource):
    """Masks of all views, empty but of ``shown``; fails before ``breaks``."""

    shown: range = range(9)
    breaks: int = 99

    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        def maps():
            for index in range(len(scene.photos)):
                if index == self.breaks:
                    raise UserError("interrupted")
                yield truth(0).astype(np.uint16) * np.uint16(index in self.shown)

        return MadeMasks({0: "background", 1: "cup", 2: "box"}, maps(), [])


def test_objects_that_most_made_masks_lack_are_named(tmp_path):
    write_transforms(tmp_path)
    data = BeagsDataParserConfig(data=tmp_path)
    assert "warning: " not in " ".join(make_masks(data, Scripted()))
    lines = make_masks(data, Scripted(shown=range(3, 4)), output=tmp_path / "made")
    warnings = [line for line in lines if line.startswith(f"warning: {tmp_path / 'made/masks/v03.png'} is the only")]
    assert ["1 (cup)" in warnings[0], "2 (box)" in warnings[1]] == [True, True] and "of 7 should" in warnings[0]


def test_masks_are_made_of_data_that_training_would_refuse(tmp_path):
    """Splits without held-out views: training names them, and the masks are kept."""
    write_transforms(tmp_path, train_filenames=["images/v01.png", "images/v02.png"])
    data = BeagsDataParserConfig(data=tmp_path)
    assert "masks of" in " ".join(make_masks(data, Scripted()))
    assert (tmp_path / "masks/v01.png").exists() and (tmp_path / "classes.json").exists()


def test_masks_are_replaced_once_all_are_made(tmp_path):
    write_transforms(tmp_path)
    data = BeagsDataParserConfig(data=tmp_path)
    assert "9 masks of 9 views, 2 objects" in " ".join(make_masks(data, Scripted()))
    (tmp_path / "classes.json").unlink()
    with pytest.raises(UserError, match=r"already \(masks/v00.png\): add --overwrite"):
        make_masks(data, Scripted())
    kept = {path: path.read_bytes() for path in (tmp_path / "masks").iterdir()}
    with pytest.raises(UserError, match="interrupted"):
        make_masks(data, Scripted(breaks=4, shown=range(2)), overwrite=True)
    assert {path: path.read_bytes() for path in (tmp_path / "masks").iterdir()} == kept


@pytest.mark.parametrize("lens", [{}, {"k1": -0.12, "k2": 0.02}])
def test_reprojection_of_a_run_writes_masks_of_the_photos_size(tmp_path, lens, capsys):
    data = write_scene(tmp_path / "scene")
    if lens:
        meta = json.loads((data / "transforms.json").read_text())
        (data / "transforms.json").write_text(json.dumps({**meta, **lens}))
    config = write_trained(tmp_path / "run", data)
    main(["masks", "reproject", "--load-config", str(config), "--output", str(tmp_path / "out")])
    assert "reprojection pairwise: 7 views have" in " ".join(capsys.readouterr().out.split())
    masks = sorted((tmp_path / "out/masks").glob("*.png"))
    assert [path.stem for path in masks] == [f"v{index:02d}" for index in range(1, 8)]
    assert all(read_id_mask(path).shape == (HEIGHT, WIDTH) for path in masks)
    assert (tmp_path / "out/before_after.png").exists() and (tmp_path / "out/confidence/v01.png").exists()
    confidence = [read_id_mask(tmp_path / "out/confidence" / path.name) for path in masks]
    assert all(values.shape == (HEIGHT, WIDTH) and values.max() > 0 for values in confidence)
    for mask, values in zip(masks, confidence, strict=True):
        unlabelled = read_id_mask(mask) == IGNORE
        assert not values[unlabelled].any()  # The straight view does not reach these, or nothing voted.
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["method"] == "pairwise"
    before = read_id_mask(data / "masks/v01.png")
    after = read_id_mask(masks[0])
    if not lens:
        assert report["views"][0]["changed"] == int((before != after).sum())
    main(["masks", "check", "--load-config", str(config), "--masks-path", str(tmp_path / "out/masks"),
          "--output", str(tmp_path / "check")])  # fmt: skip
    assert (tmp_path / "check/report.json").exists()


def test_the_check_of_a_run_takes_its_options_and_what_replaces_them(tmp_path):
    from beags_plugin.objects.check_masks import options_beside
    from beags_plugin.objects.reproject_masks import ReprojectionOptions, data_to_reproject
    from beags_plugin.runs.run import Run

    data = write_scene(tmp_path / "scene")
    config = write_trained(tmp_path / "run", data)
    run = Run(config)
    own = options_beside(run, None)
    assert own.data == data and own.orientation_method == "none"  # The run was trained with these.
    (data / "masks").rename(data / "others")
    parser = options_beside(run, None, masks_path=Path("others"), ignore_ids=(2,), layout=None)
    assert (parser.layout, parser.orientation_method) == (own.layout, "none")
    manager = data_to_reproject(run, ReprojectionOptions(run_size=True, parser=parser))
    labels = manager.views("train")[0].labels
    assert labels is not None and set(labels.unique().tolist()) == {0, 1, IGNORE}
    main(["masks", "check", "--load-config", str(config), "--masks-path", "others", "--output", str(tmp_path / "out")])
    assert json.loads((tmp_path / "out/report.json").read_text())["coverage"][0]["pixels"]["2"] == 16


def test_the_geometry_of_a_run_has_its_held_out_views_too(tmp_path):
    from beags_plugin.objects.make_masks import RunGeometry
    from beags_plugin.runs.run import Run

    data = write_scene(tmp_path / "scene")
    geometry = RunGeometry(Run(write_trained(tmp_path / "run", data)))
    assert [path.stem for path in geometry.images] == [f"v{index:02d}" for index in (*range(1, 8), 0, 8)]
    ids = truth(0)
    for view in (0, 7, 8):
        straight = geometry.to_straight(ids.astype(np.uint16), view)
        np.testing.assert_array_equal(geometry.to_photo(straight, view), ids)  # this scene has no lens distortion


def test_masks_are_made_in_a_copy_of_the_scene_that_the_run_was_trained_on(tmp_path):
    """The recorded folder still exists: the named one counts all the same."""
    from shutil import copytree

    data = write_scene(tmp_path / "scene", masks=False)
    config = write_trained(tmp_path / "run", data)
    copytree(data, tmp_path / "copy")
    row, column = (drawn_labels(ring_cameras(9, 1)[1]) == 1).nonzero()[0].tolist()
    cup = {"name": "cup", "prompts": [{"view": "v01", "points": [[column, row]]}]}
    (tmp_path / "prompts.json").write_text(json.dumps({"objects": [cup]}))
    main(["masks", "make", "--data", str(tmp_path / "copy"), "--source", "cut", "--load-config", str(config),
          "--overwrite", "--options", f"prompts={tmp_path / 'prompts.json'}"])  # fmt: skip
    assert len(list((tmp_path / "copy/masks").glob("*.png"))) > 0 and not (data / "masks").exists()


def test_agreement_overrules_the_mask_that_contradicts_the_others(tmp_path, capsys):
    data, names = tmp_path / "data", [f"v{index:02d}" for index in range(9)]
    surfels, _ = discs()
    write_drawn_scene(data)
    right = {name: read_id_mask(data / f"masks/{name}.png") for name in names}
    write_image(data / "masks/v03.png", np.where(right["v03"] == 1, 0, 1).astype(np.uint8))  # inverted
    config = write_trained(tmp_path / "run", data, assigned=False)
    main(["masks", "agree", "--load-config", str(config), "--output", str(tmp_path / "agreed")])
    out = " ".join(capsys.readouterr().out.split())
    assert "1 of 7 masks was overruled as a whole (v03)" in out and "--masks-path" in out
    report = json.loads((tmp_path / "agreed/report.json").read_text())
    assert report["overruled"] == ["v03"] and (tmp_path / "agreed/doubt.png").exists()
    for name in sorted(set(names[1:8])):
        found = read_id_mask(tmp_path / f"agreed/masks/{name}.png")
        wrong = (found != right[name]) & (found != IGNORE)
        assert wrong.mean() < (0.05 if name == "v03" else 0.003), name
    assert len(surfels) and json.loads((tmp_path / "agreed/classes.json").read_text())["1"] == "cup"
    assert not report.get("things")
    agree = ["masks", "agree", "--load-config", str(config), "--objects", "2", "--output", str(tmp_path / "apart")]
    with pytest.raises(SystemExit):
        main(agree)
    assert "the masks name 2 objects (cup, box), and only one can be" in " ".join(capsys.readouterr().out.split())
    (data / "classes.json").write_text('{"0": "background", "1": "thing"}')
    for name, mask in right.items():
        write_image(data / f"masks/{name}.png", (mask > 0).astype(np.uint8))
    main(agree)
    assert "separate thing" not in capsys.readouterr().out
    names = {"0": "background", "1": "thing 1", "2": "thing 2"}
    assert json.loads((tmp_path / "apart/classes.json").read_text()) == names
    split = {name: read_id_mask(tmp_path / f"apart/masks/{name}.png") for name in sorted(right)[1:8]}
    ids = np.array([0, 1, 2]) if (split["v01"][right["v01"] == 1] == 1).mean() > 0.5 else np.array([0, 2, 1])
    assert all((split[name] == ids[right[name]]).mean() > 0.97 for name in split)
