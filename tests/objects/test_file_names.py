"""Files and folders of objects: no two of an export or an extraction share a name, whatever objects are called."""

from __future__ import annotations

import random

import pytest
from run_folders import rename_classes, write_scene, write_trained

pytest.importorskip("nerfstudio")

from written_splats import read_ply

from beags_plugin.commands.cli import main
from beags_plugin.objects.extract import folder_names
from beags_plugin.system.reading.ply import read_vertices


@pytest.mark.parametrize(
    ("classes", "names"),
    [
        ({1: "cup 1", 2: "cup_1", 3: "Box"}, {1: "cup_1_1", 2: "cup_1_2", 3: "Box"}),
        ({1: "cup", 2: "Cup"}, {1: "cup_1", 2: "Cup_2"}),
        ({1: "cup", 2: "Cup", 3: "cup_1"}, {1: "cup_1_2", 2: "Cup_2", 3: "cup_1"}),
        ({1: "cup 1", 2: "cup_1", 3: "cup_1_2"}, {1: "cup_1_1", 2: "cup_1_2_2", 3: "cup_1_2"}),
        ({1: "cup", 2: "cup.compressed", 3: "cup.2dgs"}, {1: "cup", 2: "cup_compressed", 3: "cup_2dgs"}),
        ({1: "..", 2: "/", 3: "a/../b", 4: "Object"}, {1: "object_1", 2: "object_2", 3: "a_b", 4: "Object_4"}),
    ],
)
def test_objects_never_share_a_name(classes, names):
    assert folder_names(classes) == names


def test_names_made_of_the_same_pieces_never_meet():
    choice = random.Random(0).choice
    pieces = ("cup", "Cup", "CUP", "_", " ", ".", "1", "2", "_1", "_2", "")
    for _ in range(2000):
        classes = {index: "".join(choice(pieces) for _ in range(3)) for index in range(6)}
        names = [name.casefold() for name in folder_names(classes, ["cup_1"]).values()]
        assert len({*names, "cup_1"}) == 7 and all(name and "." not in name for name in names), classes


def test_each_object_has_files_of_its_own(tmp_path):
    """One name even ends as another's format begins; each file holds the Gaussians of its class alone."""
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    rename_classes(config, {0: "Cup", 1: "cup", 2: "cup.2dgs"})
    formats = ("ply", "ply-2dgs", "compressed-ply")
    main(["export", "--load-config", str(config), "--all", "--format", *formats, "--output", str(tmp_path / "files")])
    stems = {"Cup_0": 0, "cup_1": 1, "cup_2dgs": 2}
    suffixes = ("ply", "2dgs.ply", "compressed.ply")
    assert {path.name for path in (tmp_path / "files").glob("*.ply")} == {f"{s}.{e}" for s in stems for e in suffixes}
    main(["extract", "--load-config", str(config), "--output", str(tmp_path / "runs")])
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {"cup_1", "cup_2dgs"}
    for stem, class_id in stems.items():
        for suffix in suffixes[:2]:
            assert set(read_vertices(tmp_path / f"files/{stem}.{suffix}")["class_id"]) == {class_id}
        if class_id:
            _, ids = read_ply(tmp_path / f"runs/{stem}/{stem}.ply")
            assert ids is not None and set(ids.tolist()) == {class_id}
