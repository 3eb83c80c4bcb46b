"""``beags render`` on runs on disk."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image
from run_folders import write_camera_path, write_scene, write_trained

pytest.importorskip("nerfstudio")

from beags_plugin.cleaning.clean import LeftOut
from beags_plugin.commands.cli import main
from beags_plugin.objects.render import _subjects, render_run
from beags_plugin.pictures.options import RenderOptions
from beags_plugin.runs.belonging import Belonging
from beags_plugin.runs.run import Run
from beags_plugin.system.errors import UserError

SMALL = RenderOptions(size=32, frames=3, views=4)


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    root = tmp_path_factory.mktemp("lab")
    return write_trained(root / "run", write_scene(root / "lab"))


def read(path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"))


def test_a_sheet_of_one_object_and_of_all(config, tmp_path, capsys):
    main(
        ["render", "--load-config", str(config), "--object", "cup", "--format", "sheet", "--size", "32", "--views", "4"]
    )
    assert read(config.parent / "renders" / "cup_sheet.png").shape == (32 + 22, 4 * 36, 3)
    assert "cup_sheet.png" in capsys.readouterr().out
    everything = render_run(config, (), "sheet", tmp_path / "all.png", SMALL)
    picture = read(everything)
    assert picture.shape == (2 * 54, 4 * 36, 3) and (picture[18:50, :32] < 200).any()
    assert render_run(config, ("background",), "sheet", tmp_path / "b.png", SMALL).exists()


def test_before_and_after_differ_where_the_base_did(config, tmp_path):
    picture = read(render_run(config, ("cup",), "before-after", tmp_path / "a.png", SMALL))
    assert picture.shape == (2 * 54, 2 * 36, 3)
    before, after = picture[18:50, :32], picture[18:50, 36:68]
    assert not np.array_equal(before, after)  # the base's cup is off
    assert render_run(config, ("cup",), "before-after", tmp_path / "a.gif", SMALL).exists()


def test_what_does_not_belong_to_an_object_is_left_out_after_refinement(config, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(config.parent, run)
    opened, base = Run(run / "config.yml"), Run(run / "base/config.yml")
    (cup,) = (class_id for class_id, name in opened.scene.classes.items() if name == "cup")
    members = opened.assigned.members.of(cup).nonzero()[:, 0]
    Belonging(opened.scene, run).keep(cup, members[2:], LeftOut())
    stages = {"before": base.assigned, "after": opened.assigned}
    (subject,) = _subjects(opened, stages, {"cup": cup}, "before-after", False, SMALL)
    assert len(subject.stages["after"]) == 2 and len(subject.stages["before"]) > 2


def test_a_video_is_the_default(config):
    path = render_run(config, ("cup",), options=SMALL)
    assert path.stem == "cup_video" and path.stat().st_size > 100


@pytest.fixture
def camera_path(tmp_path):
    return write_camera_path(tmp_path / "flight.json")


def frames(path) -> list[np.ndarray]:
    av = pytest.importorskip("av")
    with av.open(str(path)) as container:
        assert container.streams.video[0].average_rate == 12
        return [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]


def test_a_camera_path_is_followed_as_nerfstudio_does(config, camera_path, tmp_path):
    from nerfstudio.cameras.camera_paths import get_path_from_json
    from nerfstudio.utils.eval_utils import eval_setup

    words = ["render", "--load-config", str(config), "--camera-path", str(camera_path), "--background", "black"]
    main(words)
    film = frames(config.parent / "renders/flight_video.mp4")
    assert [frame.shape for frame in film] == 5 * [(96, 128, 3)]
    model = eval_setup(config, test_mode="inference")[1].model
    cameras = get_path_from_json(json.loads(camera_path.read_text()))
    for index, frame in enumerate(film):
        expected = 255 * model.get_outputs_for_camera(cameras[index : index + 1])["rgb"].numpy()
        assert expected.max() > 100 and np.abs(frame - expected).mean() < 4  # H.264 loses some
        assert all(np.abs(frame - np.flip(expected, side)).mean() > 4 for side in (0, 1))
    main([*words, "--object", "cup", "box", "--output", str(tmp_path / "a.mp4")])
    main([*words, "--object", "cup", "--format", "before-after", "--output", str(tmp_path / "b.mp4")])
    both, pair = frames(tmp_path / "a.mp4"), frames(tmp_path / "b.mp4")
    assert 0 < np.count_nonzero(both[0] > 50) < np.count_nonzero(film[0] > 50)  # The background is left out.
    assert pair[0].shape == (96 + 18 + 4, 2 * (128 + 4), 3)


def test_gaussians_of_two_named_objects_are_drawn_once(config, camera_path, tmp_path):
    """An object named twice stands for objects that share Gaussians."""
    options = RenderOptions(camera_path=camera_path)
    once = frames(render_run(config, ("cup",), "video", tmp_path / "once.mp4", options))
    twice = frames(render_run(config, ("cup", "cup"), "video", tmp_path / "twice.mp4", options))
    assert all(np.array_equal(one, other) for one, other in zip(once, twice, strict=True))


def test_a_base_without_classes_is_shown_along_a_path(tmp_path, camera_path):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"), assigned=False)
    film = render_run(config, options=RenderOptions(camera_path=camera_path))
    assert film == config.parent / "renders/flight_video.mp4" and len(frames(film)) == 5


def test_the_data_are_not_needed(tmp_path):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    shutil.rmtree(tmp_path / "lab")
    assert render_run(config, ("cup",), "sheet", tmp_path / "a.png", SMALL).exists()


def test_an_unknown_format_is_refused(config):
    with pytest.raises(UserError, match="there is no format 'hologram': choose one of video, sheet, before-after."):
        render_run(config, (), "hologram", None, SMALL)


def test_a_run_that_has_kept_no_base_has_nothing_to_compare(tmp_path):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"), base=False)
    with pytest.raises(UserError, match="has no saved state from before refinement"):
        render_run(config, (), "before-after", tmp_path / "a.png", SMALL)
