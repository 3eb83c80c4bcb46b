"""What the demo makes of photos: poses and masks where they lack, once, and never over what a user did."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from data_folders import write_image
from photographed_corner import write_photos
from PIL import Image
from run_folders import write_scene
from test_documented_commands import training_config
from weights import fetch

from beags_plugin.commands import demo, demo_training, scene_setup
from beags_plugin.commands.made_masks import ChosenSource
from beags_plugin.commands.scene_setup import MadeScene
from beags_plugin.labels.classes import read_id_mask
from beags_plugin.masks.sources.salient import SalientSource
from beags_plugin.posing.photos import find_photos
from beags_plugin.system.errors import UserError

pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
pytest.importorskip("pycolmap")
PHOTOS = 12


@pytest.fixture(autouse=True)
def home(shared, monkeypatch):
    monkeypatch.setenv("U2NET_HOME", str(shared("u2net", fetch)))


def draw_thing(photo: Path) -> None:
    """Draw a thing that stands out into the middle of a photo."""
    picture = np.array(Image.open(photo).convert("RGB"))
    cv2.circle(picture, (picture.shape[1] // 2, picture.shape[0] // 2), 32, (230, 20, 30), -1)
    write_image(photo, picture)


@pytest.fixture
def photos(shared, tmp_path):
    """Return a folder of photos of a corner with a thing before it."""

    def write(folder: Path) -> None:
        write_photos(folder, PHOTOS)
        for photo in folder.iterdir():
            draw_thing(photo)

    return Path(shutil.copytree(shared("photos_of_a_thing", write), tmp_path / "walk"))


@pytest.fixture
def trainings(monkeypatch):
    """Have trainings only leave what says that they ended; return their commands."""
    commands = []

    def train(command):
        words = [Path(part).name for part in command]
        config = training_config(command[words.index("ns-train") + 1 :])
        commands.append(config)
        config.run_dir.mkdir(parents=True)
        (config.run_dir / "training.json").write_text("{}")

    monkeypatch.setattr(demo_training, "finish", train)
    monkeypatch.setattr(demo, "measure", lambda *_: None)
    return commands


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.slow("finds poses of photos made for it")
def test_photos_alone_are_trained_on_with_poses_and_masks_once(photos, tmp_path, trainings, monkeypatch, capsys):
    before = files(photos)
    demo.run_demo(photos, tmp_path / "out", None, None, 0, False)
    (config,) = trainings
    assert config.method_name == "beags-fast" and config.data == tmp_path / "out/scene"
    printed = capsys.readouterr().out
    assert "walk has no poses" in printed and "12 of 12 photos have poses" in printed and "made.png" in printed
    parser = config.data_config.dataparser
    parser.data = config.data  # ns-train does the same.
    metadata = parser.setup().get_dataparser_outputs("train").metadata
    assert metadata["classes"] == {0: "background", 1: "walk"}
    for path in metadata["mask_filenames"]:
        mask = read_id_mask(path) == 1
        assert mask[110:130, 150:170].all() and mask.mean() < 0.2  # the thing takes 4 %

    monkeypatch.setattr("beags_plugin.posing.process._report", lambda *_: pytest.fail("computed again"))
    monkeypatch.setattr(SalientSource, "make", lambda *_: pytest.fail("made again"))
    demo.run_demo(photos, tmp_path / "out", None, None, 0, False)
    assert len(trainings) == 1 and files(photos) == before
    write_image(tmp_path / "out/scene/masks/v00.png", np.zeros((240, 320), np.uint8))  # The user does this.
    with pytest.raises(UserError, match="out/run holds a run that was trained from other data .*--fresh"):
        demo.run_demo(photos, tmp_path / "out", None, None, 0, False)
    assert len(trainings) == 1
    demo.run_demo(photos, tmp_path / "out", None, None, 0, True)
    assert len(trainings) == 2


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("bear", "bear"),
        ("bear/images", "bear"),
        ("my walk.mp4", "my walk"),
        ("background", "object"),
        ("a\tb", "object"),
    ],
)
def test_the_object_is_called_as_the_photos_are(tmp_path, path, name):
    place = tmp_path / path
    place.parent.mkdir(exist_ok=True)
    place.touch() if place.suffix else place.mkdir()
    assert scene_setup.object_name(place) == name


@pytest.fixture
def posed(tmp_path, monkeypatch):
    """Return a scene of nine photos of a red thing, with poses and without masks; red stands for the network."""
    monkeypatch.setattr("beags_plugin.masks.sources.salient.load", lambda _: lambda photo: photo[..., 0] > 180)
    data = write_scene(tmp_path / "data", masks=False)
    (data / "classes.json").unlink()
    for photo in (data / "images").iterdir():
        write_image(photo, cv2.circle(np.full((60, 100, 3), 90, np.uint8), (50, 30), 14, (230, 20, 30), -1))
    return data


def test_a_scene_with_poses_gets_masks_elsewhere(posed, tmp_path, trainings):
    before = files(posed)
    demo.run_demo(posed, tmp_path / "out", "beags-tiny", None, 0, False)
    assert files(posed) == before
    (config,) = trainings
    parser = config.data_config.dataparser
    assert config.data == posed and parser.masks_path == tmp_path / "out/made/masks"
    assert parser.classes_path == tmp_path / "out/made/classes.json"
    assert read_id_mask(parser.masks_path / "v01.png")[25:35, 45:55].all()


def test_masks_are_made_anew_for_other_photos_unless_they_were_mended(posed, tmp_path, capsys):
    mask, photo = tmp_path / "out/made/masks/v01.png", posed / "images/v01.png"

    def made_of(row: int) -> bool:
        """Move the thing in a photo; return whether its mask is there."""
        write_image(photo, cv2.circle(np.full((60, 100, 3), 90, np.uint8), (50, row), 14, (230, 20, 30), -1))
        assert scene_setup.made_scene(posed, tmp_path / "out") == MadeScene(posed, tmp_path / "out/made")
        return bool(read_id_mask(mask)[row, 50])

    assert made_of(20) and made_of(40)
    assert "so they stay" not in capsys.readouterr().out
    write_image(mask, np.zeros((60, 100), np.uint8))  # The user does this.
    assert not made_of(20)
    assert "so they stay" in capsys.readouterr().out


def test_another_source_of_masks_is_asked_and_its_change_makes_them_anew(posed, tmp_path, trainings, monkeypatch):
    asked = []
    monkeypatch.setattr("beags_plugin.masks.sources.rembg.find_spec", lambda name: object())
    found = {"isnet-general-use": 90, "birefnet-general": 180}
    monkeypatch.setattr(
        "beags_plugin.masks.sources.rembg.load",
        # The source asks twice: to check, and to make.
        lambda model: asked.append(model) or (lambda photo: photo[..., 0] > found[model]),
    )

    def run(*options: str) -> set[str]:
        demo.run_demo(posed, tmp_path / "out", "beags-tiny", None, 0, True, mask_source="rembg", mask_options=options)
        return {label for label in (tmp_path / "out/made/classes.json").read_text().split('"') if label.isalpha()}

    assert run("name=cup") == {"background", "cup"} and asked == 2 * ["isnet-general-use"]
    shutil.rmtree(tmp_path / "out/run")
    run("name=cup")
    assert asked[2:] == ["isnet-general-use"], "they are as they were made"
    shutil.rmtree(tmp_path / "out/run")
    assert run("model=birefnet-general") == {"background", "data"} and asked[3:] == 2 * ["birefnet-general"]


@pytest.mark.parametrize(
    ("chosen", "library", "sentence"),
    [
        (ChosenSource("rembg"), "rembg", "cannot fetch the weights of isnet-general-use"),
        (ChosenSource("sam2", ("model=/none/such",)), "transformers", "there is no folder /none/such"),
        (ChosenSource("sam2", ("prompts=none.json",)), "transformers", r"the prompts none\.json cannot be read"),
    ],
)
def test_weights_that_lack_are_named_before_poses_are_computed(
    photos, tmp_path, monkeypatch, chosen, library, sentence
):
    if library == "rembg":
        monkeypatch.setattr("beags_plugin.masks.sources.rembg.find_spec", lambda name: object())
        monkeypatch.setattr("beags_plugin.masks.sources.rembg.import_module", lambda name: NoWeights)
    else:
        pytest.importorskip(library, reason="the extra [sam2] (transformers) is not installed")
        (photos / "prompts.json").write_text('{"objects": [{"name": "cup", "text": "cup"}]}')
    with pytest.raises(UserError, match=sentence):
        scene_setup.made_scene(photos, tmp_path / "out", chosen=chosen.below(photos))
    assert not (tmp_path / "out").exists()


def test_prompts_beside_the_photos_are_found_and_masks_are_made_anew_once_they_change(posed):
    pytest.importorskip("transformers", reason="the extra [sam2] (transformers) is not installed")
    (posed / "prompts.json").write_text("[1]")
    chosen = ChosenSource("sam2", ("prompts=prompts.json", "model=facebook/sam3")).below(posed)
    assert chosen.options == (f"prompts={posed / 'prompts.json'}", "model=facebook/sam3")
    usual = ChosenSource("sam2", ("model=facebook/sam3",)).below(posed)
    assert set(usual.options) == set(chosen.options)
    before = chosen.digest()
    assert before == chosen.digest()
    (posed / "prompts.json").write_text("[2]")
    assert before != chosen.digest()


class NoWeights:
    """The library rembg and its rembg.sessions, without a network."""

    sessions_names = ("isnet-general-use",)

    @staticmethod
    def new_session(model: str):
        raise ConnectionError(model)


def test_a_source_that_does_not_fit_is_refused(posed, tmp_path):
    def run(source: str, data: Path | None = posed, **options) -> None:
        demo.run_demo(data, tmp_path / "out", "beags-tiny", None, 0, False, mask_source=source, **options)

    with pytest.raises(UserError, match="cannot ask the mask source cut, which needs a trained run or masks made else"):
        run("cut")
    with pytest.raises(UserError, match="there is no mask source 'rembgs'"):
        run("rembgs")
    with pytest.raises(UserError, match="leave --mask-source out"):
        run("rembg", None)
    write_image(posed / "masks/v01.png", np.ones((60, 100), np.uint8))
    with pytest.raises(UserError, match=r"has masks already: .* --source rembg --options model=u2netp --overwrite\."):
        run("rembg", mask_options=("model=u2netp",))
    assert not (tmp_path / "out").exists()


def test_a_network_that_finds_nothing_is_a_user_error(posed, tmp_path):
    for photo in (posed / "images").iterdir():
        write_image(photo, np.full((60, 100, 3), 90, np.uint8))
    with pytest.raises(UserError, match="found no object in any view"):
        scene_setup.made_scene(posed, tmp_path / "out")
    assert not any((tmp_path / "out/made").rglob("*.png"))


@pytest.mark.slow("finds poses of photos made for it")
def test_masks_of_photos_without_poses_are_taken(photos, tmp_path, monkeypatch):
    scene = tmp_path / "given"
    scene.mkdir()
    photos.rename(scene / "images")
    for photo in (scene / "images").iterdir():
        write_image(scene / "masks" / photo.name, np.ones((240, 320), np.uint8))
    monkeypatch.setattr(SalientSource, "unavailable", classmethod(lambda _: "not needed."))
    made = scene_setup.made_scene(scene, tmp_path / "out")
    assert made == MadeScene(tmp_path / "out/scene", scene)
    assert made.options() == ["--masks-path", str(scene / "masks")]


def test_masks_of_photos_that_lie_on_their_side_are_refused_before_poses_are_computed(photos, tmp_path):
    turned = Image.open(photos / "v03.png")
    exif = turned.getexif()
    exif[274] = 3
    turned.save(photos / "v03.png", exif=exif)
    for photo in list(photos.iterdir()):
        write_image(photos / "masks" / photo.name, np.ones((240, 320), np.uint8))
    with pytest.raises(UserError, match=r"v03\.png is stored on its side"):
        scene_setup.made_scene(photos, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_outputs_inside_the_data_are_no_data(posed, trainings, monkeypatch):
    monkeypatch.chdir(posed)
    for _ in range(2):
        demo.run_demo(Path(), None, "beags-tiny", None, 0, False)
        (posed / "outputs/data/contact_sheet.png").write_text("drawn by the demo")
    assert len(trainings) == 1
    with pytest.raises(UserError, match="is the data: give another --output"):
        demo.run_demo(posed, posed, "beags-tiny", None, 0, False)


def test_what_the_program_drew_is_no_photo(photos):
    names = sorted(path.name for path in photos.iterdir())
    for name in ("made.png", "poses.png", "contact_sheet.png"):
        write_image(photos / name, np.zeros((240, 320, 3), np.uint8))
    assert [path.name for path in find_photos(photos)] == names
    within = photos.parent / "within"
    within.mkdir()
    photos.rename(within / "images")
    write_image(within / "stray.png", np.zeros((240, 320, 3), np.uint8))
    assert [path.name for path in find_photos(within)] == names


def test_other_photos_and_incomplete_scenes_are_refused(photos, tmp_path):
    (tmp_path / "out/scene").mkdir(parents=True)
    (tmp_path / "out/scene/made_of.json").write_text('"/elsewhere/walk.mp4"')
    with pytest.raises(UserError, match="was made of /elsewhere/walk.mp4: give another --output"):
        scene_setup.made_scene(photos, tmp_path / "out")
    (photos / "transforms_train.json").write_text("{}")  # Another program's file.
    with pytest.raises(UserError, match=r"holds neither transforms\.json"):
        scene_setup.made_scene(photos, tmp_path / "other")


def test_masks_that_were_interrupted_are_made_anew(posed, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("beags_plugin.objects.make_masks.check", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            scene_setup.made_scene(posed, tmp_path / "out")
    mask = tmp_path / "out/made/masks/v01.png"
    assert mask.exists()
    mask.unlink()  # It has not been moved yet.
    scene_setup.made_scene(posed, tmp_path / "out")
    assert mask.exists()


def test_what_lacks_for_masks_is_said_before_poses_are_computed(photos, tmp_path, monkeypatch):
    monkeypatch.setattr(SalientSource, "unavailable", classmethod(lambda _: "no onnxruntime."))
    model = photos / "outputs/walk/scene/colmap/sparse/0/cameras.bin"  # An earlier demo's file.
    model.parent.mkdir(parents=True)
    model.touch()
    with pytest.raises(UserError, match=r"the source salient cannot make any: no onnxruntime\."):
        scene_setup.made_scene(photos, tmp_path / "out")
    assert not (tmp_path / "out").exists()
