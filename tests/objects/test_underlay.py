"""``beags render --underlay``: pictures to draw silhouettes over, and the drawings as truth of ``beags eval``."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

pytest.importorskip("nerfstudio")

from data_folders import HEIGHT, WIDTH, write_image
from PIL import Image
from run_folders import write_drawn_scene, write_scene, write_trained

from beags_plugin.commands import cli
from beags_plugin.objects.evaluate import evaluate_run
from beags_plugin.objects.underlay import FADED, GREY, write_underlays
from beags_plugin.system.errors import UserError

FACTOR = 4


def read(path) -> np.ndarray:
    return np.asarray(Image.open(path)).astype(float)


def drawn_over(underlay, photo) -> np.ndarray:
    """Return where an underlay differs from the faded photo, as someone who draws would see it."""
    faded = FADED * photo + (1 - FADED) * GREY * 255
    return np.abs(underlay - faded).max(axis=2) > 12


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    root = tmp_path_factory.mktemp("underlay")
    write_drawn_scene(root / "data", FACTOR)
    return write_trained(root / "run", root / "data")


def test_each_object_is_drawn_alone_in_every_held_out_view(run):
    data, done = run.parent.parent / "data", []
    made = write_underlays(run, progress=lambda *each: done.append(each))
    assert made.folder == run.parent / "renders/underlay" and made.silhouettes == data / "ground_truth/silhouettes"
    assert made.count == 4 and done == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert sorted(path.relative_to(made.folder).as_posix() for path in made.folder.rglob("*.png")) == [
        f"{name}/{view}.png" for name in ("box", "cup") for view in ("v00", "v08")
    ]
    photo = read(data / "images/v00.png")
    cup, box = (drawn_over(read(made.folder / name / "v00.png"), photo) for name in ("cup", "box"))
    assert photo.shape == (FACTOR * HEIGHT, FACTOR * WIDTH, 3) and cup.shape == photo.shape[:2]
    assert cup.sum() > 50 and box.sum() > 50 and not cup.all()
    labels = read(data / "masks/v00.png")
    assert cup[labels == 1].mean() > 0.5 and cup[labels == 0].mean() < 0.2


def test_what_was_drawn_over_them_is_read_back(tmp_path):
    """A drawing of where the object covers half or more: its own extraction agrees with it."""
    import torch
    from paper_trees import covered
    from run_folders import discs, ring_cameras

    from beags_plugin.core.membership import Membership
    from beags_plugin.core.select import select_class

    write_drawn_scene(tmp_path / "data", FACTOR)
    config = write_trained(tmp_path / "run", tmp_path / "data")
    assert evaluate_run(config).after.extracted_truth == "visible"
    made = write_underlays(config, ["cup"])
    surfels, ids = discs()
    cup = select_class(surfels, Membership(ids), 1)[0]
    cameras = ring_cameras(9, FACTOR)
    for name, camera in (("v00", cameras[0]), ("v08", cameras[8])):
        underlay = made.folder / "cup" / f"{name}.png"
        drawing = 255 * covered(cup, camera).to(torch.uint8).numpy()
        assert drawing.shape == read(underlay).shape[:2]
        write_image(made.silhouettes / "cup" / underlay.name, drawing)
    after = evaluate_run(config).after
    assert after.extracted_truth == "both" and after.objects[1].extracted.iou == pytest.approx(1.0)
    assert {mask.truth for mask in after.masks if mask.kind == "extracted" and mask.class_id == 1} == {"silhouette"}


def test_an_underlay_itself_is_no_silhouette(run):
    """A faded photo with more detail than those of the discs, saved by mistake."""
    silhouettes = run.parent.parent / "data/ground_truth/silhouettes/cup/v00.png"
    picture = np.random.default_rng(0).integers(0, 256, (FACTOR * HEIGHT, FACTOR * WIDTH, 3), dtype=np.uint8)
    write_image(silhouettes, (FADED * picture + (1 - FADED) * GREY * 255).astype(np.uint8))
    try:
        with pytest.raises(UserError, match="v00.png is a picture: fill the object white on black, without the photo"):
            evaluate_run(run)
    finally:
        silhouettes.unlink()


def test_underlays_have_the_lens_distortion_of_the_photos(tmp_path):
    """Drawn in the photo's file, and so undistorted with it when it is evaluated."""
    import json

    write_drawn_scene(tmp_path / "data", FACTOR)
    file = tmp_path / "data/transforms.json"
    meta = json.loads(file.read_text())
    file.write_text(json.dumps({**meta, "k1": -0.25, "k2": 0.05, "p1": 0.0, "p2": 0.0}))
    config = write_trained(tmp_path / "run", tmp_path / "data")
    made = write_underlays(config, ["cup"])
    photo = np.zeros((FACTOR * HEIGHT, FACTOR * WIDTH, 3))
    for name in ("v00", "v08"):
        underlay = read(made.folder / "cup" / f"{name}.png")
        assert underlay.shape == photo.shape  # the straight view is smaller
        drawing = drawn_over(underlay, read(tmp_path / f"data/images/{name}.png"))
        write_image(made.silhouettes / "cup" / f"{name}.png", 255 * drawing.astype(np.uint8))
    extracted = evaluate_run(config).after.objects[1].extracted
    assert extracted is not None and extracted.iou > 0.6


MISTAKES = {
    "format": ("--format sheet", "an underlay has the cameras and sizes of the held-out photos"),
    "options": ("--size 64", "an underlay has the cameras and sizes of the held-out photos"),
    "object": ("--object mug", "there is no object 'mug'"),
    "file": ("--output {file}", "is a file: name a folder with --output"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence(run, mistake, tmp_path, capsys):
    words, sentence = MISTAKES[mistake]
    (tmp_path / "file").touch()
    words = words.format(file=tmp_path / "file").split()
    with pytest.raises(SystemExit) as ended:
        cli.main(["render", "--load-config", str(run), "--underlay", *words])
    assert ended.value.code == 2 and sentence in " ".join(capsys.readouterr().out.split())


def test_the_command_says_where_drawings_go(run, tmp_path, capsys):
    cli.main(["render", "--load-config", str(run), "--underlay", "--object", "cup", "--output", str(tmp_path / "out")])
    text = " ".join(capsys.readouterr().out.split())
    assert f"underlay: 2 pictures in {tmp_path}/out" in text
    assert f"{run.parent.parent}/data/ground_truth/silhouettes/<object>/<photo>.png; beags eval reads it." in text


def test_the_photos_are_those_of_the_named_folder(run, tmp_path):
    """The recorded folder still exists: the named one counts all the same."""
    data = run.parent.parent / "data"
    shutil.copytree(data, tmp_path / "other")
    white = np.full((FACTOR * HEIGHT, FACTOR * WIDTH, 3), 255, np.uint8)
    write_image(tmp_path / "other/images/v00.png", white)
    made = write_underlays(run, ["cup"], tmp_path / "out", data=tmp_path / "other")
    assert made.silhouettes == tmp_path / "other/ground_truth/silhouettes"
    underlay = read(made.folder / "cup/v00.png")
    assert not drawn_over(underlay, white)[0].any() and drawn_over(underlay, read(data / "images/v00.png"))[0].any()


def test_a_base_without_classes_has_no_underlay(tmp_path):
    write_scene(tmp_path / "data")
    config = write_trained(tmp_path / "run", tmp_path / "data", assigned=False)
    with pytest.raises(UserError, match="is a base without classes"):
        write_underlays(config)
