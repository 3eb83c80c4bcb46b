"""What counts as truth of the held-out views."""

from __future__ import annotations

import shutil

import pytest
import torch
from data_folders import WIDTH
from run_folders import write_scene

pytest.importorskip("nerfstudio")

from beags_plugin.plugin.views.datamanager import BeagsDataManagerConfig
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.views.held_out_views import HeldOutViews


@pytest.mark.parametrize("given", [True, False])
def test_masks_that_a_program_made_of_all_photos_are_trained_on_but_are_no_truth(tmp_path, given):
    data = write_scene(tmp_path)
    if not given:
        (data / "masks/no_truth.json").write_text("{}")
    manager = BeagsDataManagerConfig(dataparser=BeagsDataParserConfig(data=data)).setup(device="cpu")
    views = HeldOutViews(manager, {0: "background", 1: "cup", 2: "box"}, torch.zeros(3))
    assert all((view.visible is not None) == given for view in views) and len(views) > 0
    assert all(view.labels is not None for view in manager.views("train"))


def opened(data) -> HeldOutViews:
    manager = BeagsDataManagerConfig(dataparser=BeagsDataParserConfig(data=data)).setup(device="cpu")
    return HeldOutViews(manager, {0: "background", 1: "cup", 2: "box"}, torch.zeros(3))


def test_truth_without_a_photo_is_named_and_the_rest_counts(tmp_path, capsys):
    data = write_scene(tmp_path / "lab", truth_factor=2)
    assert opened(data).stray_truth is None
    truth = data / "ground_truth"
    shutil.copy(truth / "silhouettes/cup/v00.png", truth / "silhouettes/cup/w05.png")
    shutil.copy(truth / "silhouettes/cup/v00.png", truth / "silhouettes/cup/v01.png")  # a training photo has it
    shutil.copytree(truth / "silhouettes/cup", truth / "visible/box/deep")  # No photo has this path.
    for name in ("v01", "w05"):
        (truth / f"visible/box/deep/{name}.png").unlink()
    capsys.readouterr()
    views = opened(data)
    note = f"3 of the 8 files in {truth} have the name of no photo that has a pose, and do not count, "
    assert views.stray_truth == note + "silhouettes/cup/w05.png among them: name them as their photos, or remove them."
    assert " ".join(views.stray_truth.split()) in " ".join(capsys.readouterr().out.split())  # Training says it as well.
    assert views[0].silhouettes is not None and list(views[0].silhouettes) == [1]


def test_truth_of_another_scene_is_named_and_nothing_ends(tmp_path):
    data = write_scene(tmp_path / "lab", truth_factor=2)
    for path in sorted((data / "ground_truth").rglob("*.png")):
        path.rename(path.with_stem(path.stem.replace("v", "frame_")))
    views = opened(data)
    assert views.stray_truth == (
        f"No exact mask in {data}/ground_truth has the name of a photo here (v00.png, ...), so none counts: name them "
        "as their photos, or remove them if they are of another scene."
    )
    assert views[0].silhouettes is None and views[0].visible is not None  # The scene's own masks serve.


def test_photos_that_were_scaled_down_are_read_at_the_size_of_their_files(tmp_path):
    data = write_scene(tmp_path)
    assert opened(data)[0].full is None
    parser = BeagsDataParserConfig(data=data, downscale_factor=2.0)
    manager = BeagsDataManagerConfig(dataparser=parser).setup(device="cpu")
    view, whole = HeldOutViews(manager, {0: "background"}, torch.zeros(3))[1], opened(data)[1]
    assert view.camera.width == WIDTH // 2 and view.full.camera.width == WIDTH
    assert torch.equal(view.full.camera.K, whole.camera.K)
    camera, photo = view.full.region((3, 2, 9, 7))
    assert torch.equal(photo, whole.image[2:7, 3:9]) and (camera.width, camera.height) == (6, 5)
    shift = torch.tensor([[0, 0, 3.0], [0, 0, 2.0], [0, 0, 0]])
    assert torch.equal(camera.K, whole.camera.K - shift) and torch.equal(camera.viewmat, view.camera.viewmat)
