"""A thing that turns before a room that stands: the demo finds it, and takes poses of the thing."""

from __future__ import annotations

import numpy as np
import pytest
from data_folders import noise, write_image
from photographed_corner import HEIGHT, WIDTH, camera, frames, photograph

pytest.importorskip("nerfstudio")
pytest.importorskip("pycolmap")

from beags_plugin.commands import demo, demo_training
from beags_plugin.commands.process import find_poses
from beags_plugin.commands.scene_setup import MadeScene, made_scene
from beags_plugin.labels.classes import read_id_mask
from beags_plugin.masks.sources.salient import SalientSource
from beags_plugin.objects.check_masks import check_scene
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.posing.process import NothingFits
from beags_plugin.system.errors import UserError

pytestmark = pytest.mark.slow("poses are found anew from photos of each scene")

PHOTOS = 12
_y, _x = np.mgrid[:HEIGHT, :WIDTH]
THING = (_x - WIDTH / 2) ** 2 + (_y - HEIGHT / 2) ** 2 < 80**2  # [H, W] bool: where every photo shows it


def motions(poses: dict[str, np.ndarray]) -> np.ndarray:
    """Return the degrees [N, N] by which the camera turns between photos."""
    turns = np.stack([poses[name][:3, :3] for name in sorted(poses)])
    return np.rad2deg(np.arccos(np.clip((np.einsum("aij,bij->ab", turns, turns) - 1) / 2, -1, 1)))


def write_turntable(folder, room=(0.7, 0.9), plain=PHOTOS) -> np.ndarray:
    """Write photos in which the thing turns by more than the camera goes round the room; returns its ``motions``.

    plain: the first photo in which it shows no texture.
    """
    poses = {}
    for index, share in enumerate(np.linspace(0, 1, PHOTOS)):
        height = 1.2 + 0.4 * (index % 3)
        of_room, of_thing = (camera(one + (other - one) * share, height) for one, other in (room, (0.25, 1.3)))
        shown = photograph(of_thing, seed=1) if index < plain else np.full(3, 90, np.uint8)
        picture = np.where(THING[..., None], shown, photograph(of_room))
        name = f"v{index:02d}"
        write_image(folder / f"{name}.png", picture)
        poses[name] = of_thing
    return motions(poses)


@pytest.fixture
def network(monkeypatch):
    """Have a network that marks the thing."""
    monkeypatch.setattr(SalientSource, "unavailable", classmethod(lambda _: None))
    monkeypatch.setattr("beags_plugin.masks.sources.salient.fetch_weights", lambda *_: None)
    monkeypatch.setattr("beags_plugin.masks.sources.salient.load", lambda _: lambda photo: THING)


def test_poses_of_a_thing_that_turned_are_its_own(tmp_path, network, monkeypatch, capsys):
    true = write_turntable(tmp_path / "photos")
    made = made_scene(tmp_path / "photos", tmp_path / "out")
    printed = capsys.readouterr().out
    assert "as if the objects had turned while the room stood still" in printed
    assert "Poses and training use the objects alone" in printed
    assert made == MadeScene(tmp_path / "out/turned", tmp_path / "out/turned/labels", turned=True)
    assert (tmp_path / "out/turned/labels/masks/no_truth.json").exists()
    own, room = frames(tmp_path / "out/turned"), frames(tmp_path / "out/scene")
    assert len(own) == PHOTOS and np.abs(motions(own) - true).max() < 3
    assert np.abs(motions(room) - true).max() > 20
    for scene, warned in ((MadeScene(tmp_path / "out/scene"), True), (made, False)):
        labels = (scene.labels or scene.data).absolute()
        report = check_scene(BeagsDataParserConfig(data=scene.data, masks_path=labels / "masks"))
        assert any(issue.kind == "turned" for issue in report.issues) == warned
    monkeypatch.setattr("beags_plugin.posing.process._report", lambda *_: pytest.fail("computed again"))
    monkeypatch.setattr(SalientSource, "make", lambda *_: pytest.fail("made again"))
    assert made_scene(tmp_path / "photos", tmp_path / "out") == made


def test_a_second_call_takes_mended_masks_and_forgets_photos_that_are_left_out(tmp_path, network):
    write_turntable(tmp_path / "photos")
    made_scene(tmp_path / "photos", tmp_path / "out")
    wider = np.zeros((HEIGHT, WIDTH), np.uint8)
    wider[30:210, 70:250] = 1
    write_image(tmp_path / "out/scene/masks/v03.png", wider)
    write_image(tmp_path / "out/turned/labels/masks/v04.png", wider)
    (tmp_path / "photos/v05.png").unlink()
    made = made_scene(tmp_path / "photos", tmp_path / "out")
    assert made.turned and made.labels is not None
    for mended in ("v03", "v04"):
        assert (read_id_mask(made.labels / f"masks/{mended}.png") == wider).all()
    assert "v05" not in frames(made.data) and "v05" not in frames(tmp_path / "out/scene")


def test_masks_that_were_given_are_taken_and_the_thing_is_trained_on_alone(tmp_path, monkeypatch):
    write_turntable(tmp_path / "photos/images")
    for index in range(PHOTOS):
        write_image(tmp_path / f"photos/masks/v{index:02d}.png", THING.astype(np.uint8))
    trained = []
    monkeypatch.setattr(demo_training, "train", lambda *arguments: trained.append(arguments))
    monkeypatch.setattr(demo, "measure", lambda *_: None)
    demo.run_demo(tmp_path / "photos", tmp_path / "out", None, 1.0, 0, False)
    scene = MadeScene(tmp_path / "out/turned", tmp_path / "photos", turned=True)
    assert trained == [(scene, tmp_path / "out/run", "beags-fast", 1.0, "objects", ())]


def test_a_thing_that_stands_in_its_room_keeps_the_poses_of_both(tmp_path, capsys):
    write_turntable(tmp_path / "photos/images", room=(0.25, 1.3))
    for index in range(PHOTOS):
        write_image(tmp_path / f"photos/masks/v{index:02d}.png", THING.astype(np.uint8))
    assert made_scene(tmp_path / "photos", tmp_path / "out") == MadeScene(tmp_path / "out/scene", tmp_path / "photos")
    assert "turned" not in capsys.readouterr().out


@pytest.mark.parametrize("room", [True, False])
def test_poses_of_too_few_photos_are_not_taken(tmp_path, room, monkeypatch, capsys):
    """The thing shows texture in the first photos alone; with poses of whole photos, or without."""

    def found(data, output, start, masks=None):
        lines = find_poses(data, output, start, masks)
        if masks is None and not room:
            raise NothingFits("none of the photos fit")
        return lines

    monkeypatch.setattr("beags_plugin.commands.scene_setup.find_poses", found)
    write_turntable(tmp_path / "photos/images", plain=5)
    for index in range(PHOTOS):
        write_image(tmp_path / f"photos/masks/v{index:02d}.png", THING.astype(np.uint8))
    if room:
        made = made_scene(tmp_path / "photos", tmp_path / "out")
        assert made == MadeScene(tmp_path / "out/scene", tmp_path / "photos")
    else:
        with pytest.raises(NothingFits):
            made_scene(tmp_path / "photos", tmp_path / "out")
    assert "The poses of the objects alone are too few" in capsys.readouterr().out


def test_what_fits_nowhere_is_said_with_what_to_do(tmp_path, network, capsys):
    for index in range(4):
        write_image(tmp_path / f"photos/x{index}.png", noise(index, WIDTH, HEIGHT))
    with pytest.raises(UserError, match="none of the 4 photos fit together"):
        made_scene(tmp_path / "photos", tmp_path / "out")
    assert "no poses of the objects alone" in capsys.readouterr().out


def test_poses_that_the_room_does_not_give_are_looked_for_on_the_objects(tmp_path, network):
    """The camera stands still: without a baseline the room gives none."""
    true = write_turntable(tmp_path / "photos", room=(0.7, 0.7))
    made = made_scene(tmp_path / "photos", tmp_path / "out")
    assert made.turned and np.abs(motions(frames(made.data)) - true).max() < 3
