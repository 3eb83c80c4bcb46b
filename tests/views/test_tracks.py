"""Which photos show the seed points of a scene, as ``seed_tracks.json`` says."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("nerfstudio")

from data_folders import HEIGHT, WIDTH, write_transforms

from beags_plugin.plugin.views.dataparser import BeagsDataParser, BeagsDataParserConfig
from beags_plugin.system.errors import UserError
from beags_plugin.views.cameras import camera_from_nerfstudio

POINTS = np.array([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1], [-0.2, 0.3, 0.2]])
TRACKS = {"photos": ["v01", "v00", "v03", "unknown"], "points": [[0, 2], [], [1, 2, 3]]}


def parser_of(root, content: str | None, held_out: bool = True) -> BeagsDataParser:
    write_transforms(root, ply_file_path="points.ply")
    rows = "".join(f"{x} {y} {z} 10 20 30\n" for x, y, z in POINTS)
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    colors = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    header = f"ply\nformat ascii 1.0\nelement vertex {len(POINTS)}\n{names}{colors}end_header\n"
    (root / "points.ply").write_text(header + rows)
    if content is not None:
        (root / "seed_tracks.json").write_text(content)
    parser = BeagsDataParserConfig(data=root, eval_interval=8 if held_out else 0).setup()
    parser.get_dataparser_outputs("train")
    return parser


def test_each_view_gets_its_points_and_where_it_shows_them(tmp_path):
    parser = parser_of(tmp_path, json.dumps(TRACKS), held_out=False)
    outputs = parser.get_dataparser_outputs("train")
    tracks = parser.tracks("train")
    expected = {"v00": [2], "v01": [0], "v03": [0, 2]}
    for view, path in enumerate(outputs.image_filenames):
        ids, places = tracks[view]
        assert ids.tolist() == expected.get(path.stem, [])
        camera = camera_from_nerfstudio(outputs.cameras, view)
        local = (
            outputs.metadata["points3D_xyz"].numpy()[ids] @ camera.rotation.numpy().T + camera.viewmat[:3, 3].numpy()
        )
        x, y, z = camera.K.numpy() @ local.T
        assert np.allclose(places * (WIDTH, HEIGHT), np.stack([x / z, y / z], axis=1), atol=1e-4)


def test_a_split_gets_those_of_its_views(tmp_path):
    parser = parser_of(tmp_path, json.dumps(TRACKS))  # v00 and v08 are held out
    assert [ids.tolist() for ids, _ in parser.tracks("train")] == [[0], [], [0, 2], [], [], [], []]
    assert [ids.tolist() for ids, _ in parser.tracks("test")] == [[2], []]


def test_without_the_file_nothing_is_known(tmp_path):
    assert parser_of(tmp_path, None).tracks("train") == []


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "cannot be read"),
        ("[]", "cannot be read"),
        ('{"photos": ["v01"]}', "cannot be read .*'points' is missing"),
        ('{"photos": ["v01"], "points": [[1], [], []]}', "cannot be read"),
        ('{"photos": ["v01"], "points": [[-1], [], []]}', "cannot be read .*negative"),
        ('{"photos": ["v01"], "points": [["v01"], [], []]}', "cannot be read"),
        ('{"photos": ["v01"], "points": 3}', "cannot be read"),
        ('{"photos": ["v01"], "points": [[0], []]}', "lists 2 seed points, but there are 3: delete it"),
    ],
)
def test_a_file_that_does_not_fit_is_told_in_one_sentence(tmp_path, content, words):
    parser = parser_of(tmp_path, content)
    with pytest.raises(UserError, match=f"seed_tracks.json {words}"):
        parser.tracks("train")
