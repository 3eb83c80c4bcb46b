"""Files of strangers run nothing, and do not fill the memory; the viewer listens on this machine alone."""

from __future__ import annotations

import io
import json
import os
import re
import struct
import threading
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from places import ROOT

pytest.importorskip("nerfstudio")

from data_folders import write_colmap
from mistakes.photos import huge_png
from run_folders import write_scene, write_trained

from beags_plugin.data.colmap_binary import check_colmap_binary
from beags_plugin.data.transforms_file import read_transforms
from beags_plugin.labels.classes import read_classes
from beags_plugin.masks.sources.coco import packed_total
from beags_plugin.plugin.runs import run_config
from beags_plugin.plugin.runs.run_config import load_run_config
from beags_plugin.system.errors import UserError
from beags_plugin.system.filed_tensors import FiledTensors, write_tensors
from beags_plugin.system.reading.arrays import MOST_RATIO, load_array, load_arrays
from beags_plugin.system.reading.images import read_image
from beags_plugin.system.reading.tensors import load_tensors
from beags_plugin.system.reading.text import MOST_BYTES, load_json
from beags_plugin.system.shipped import read_toml

# -- configs ---------------------------------------------------------------------------------------------------------

ATTACKS = [
    "!!python/object/apply:os.system ['touch {ran}']",
    "!!python/object/apply:subprocess.Popen [['touch', '{ran}']]",
    "!!python/object/apply:builtins.eval [\"open('{ran}', 'w')\"]",
    "!!python/object/apply:builtins.exec [\"open('{ran}', 'w')\"]",
    "!!python/object/apply:builtins.open ['{ran}', 'w']",
    "!!python/object/apply:nerfstudio.utils.scripts.run_command ['touch {ran}']",
    "!!python/object/apply:nerfstudio.utils.scripts.subprocess.run [['touch', '{ran}']]",
    "!!python/object/apply:beags_plugin.system.whole_files.write_whole ['{ran}', print]",
    "!!python/object/apply:pathlib.Path.touch ['{ran}']",
    "!!python/object/apply:torch.optim.adam.Adam [[]]",
    "!!python/object/new:subprocess.Popen [['touch', '{ran}']]",
    "!!python/object/new:beags_plugin.extraction.splat_file.SplatFile {{args: [1], state: {{a: 1}}}}",
    "!!python/name:os.system ''",
    "!!python/name:nerfstudio.utils.scripts.run_command ''",
    "!!python/module:os ''",
    "!!python/object:beags_plugin.core.densification.DensifyConfig {{__class__: 1}}",
    "!!python/object/apply:beags_plugin.nowhere.Absent []",
]


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    root = tmp_path_factory.mktemp("runs")
    return write_trained(root / "run", write_scene(root / "data"))


@pytest.mark.parametrize("attack", ATTACKS)
@pytest.mark.parametrize("hidden", [False, True])
def test_a_config_runs_nothing(config, tmp_path, attack, hidden):
    ran = tmp_path / "ran"
    text = attack.format(ran=ran)
    path = tmp_path / "config.yml"
    path.write_text(config.read_text("utf8") + f"hidden: {text}\n" if hidden else text)
    with pytest.raises(UserError, match="is refused, since it (names|calls|has)|has no such fields"):
        load_run_config(path)
    assert not ran.exists()


def test_the_attacks_would_work_elsewhere(tmp_path):
    """nerfstudio's loader runs the first of them: what is asked above says something."""
    import yaml

    ran = tmp_path / "ran"
    yaml.load(ATTACKS[0].format(ran=ran), Loader=yaml.Loader)
    assert ran.exists()


def test_configs_of_runs_are_read_as_nerfstudio_reads_them(config):
    import yaml

    text = config.read_text("utf8")
    assert yaml.dump(load_run_config(config)) == yaml.dump(yaml.load(text, Loader=yaml.Loader))


def test_every_preset_can_be_read_back(tmp_path):
    import yaml

    from beags_plugin.plugin.presets import load_preset, preset_names

    for name in preset_names():
        text = yaml.dump(load_preset(name).config)
        (tmp_path / "config.yml").write_text(text, "utf8")
        assert yaml.dump(load_run_config(tmp_path / "config.yml")) == text


def test_parts_of_other_packages_may_be_named_once_they_are_registered(config, tmp_path, monkeypatch):
    (tmp_path / "my_package.py").write_text("class MyConfig: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "config.yml"
    path.write_text(config.read_text("utf8") + "mine: !!python/name:my_package.MyConfig ''\n")
    with pytest.raises(UserError, match="names my_package.MyConfig, which no run of beags needs"):
        load_run_config(path)
    monkeypatch.setattr(run_config, "known_packages", lambda: frozenset({"beags_plugin", "nerfstudio", "my_package"}))
    assert load_run_config(path).mine.__name__ == "MyConfig"


def test_merged_tables_that_grow_without_end_are_refused(tmp_path):
    lines = ["a0: &a0 {x: 1}"]
    lines += [f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}" for i in range(1, 30)]
    (tmp_path / "config.yml").write_text("\n".join(lines))
    with pytest.raises(UserError, match="it merges tables"):
        load_run_config(tmp_path / "config.yml")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("? !!python/tuple [1, 2]\n: 3\n", "a key in it is no text"),
        ("a: " + "1:" * 200 + "1\n", "a number in it has more than 100 digits"),
    ],
)
def test_what_takes_forever_to_read_is_refused(tmp_path, text, told):
    (tmp_path / "config.yml").write_text(text)
    with pytest.raises(UserError, match=told):
        load_run_config(tmp_path / "config.yml")


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            "relative_model_dir:",
            "relative_model_dir: !!python/object/apply:pathlib.PosixPath [/etc]\nspare:",
            "elsewhere",
        ),
        (
            "_target: !!python/name:beags_plugin.plugin.trainer.BeagsTrainer ''",
            "_target: !!python/name:nerfstudio.engine.trainer.Trainer ''",
            "lets BeagsTrainerConfig make a Trainer",
        ),
    ],
)
def test_a_config_makes_its_own_kinds_in_its_own_folder(config, tmp_path, old, new, told):
    text = config.read_text("utf8")
    assert old in text
    (tmp_path / "config.yml").write_text(text.replace(old, new, 1))
    with pytest.raises(UserError, match=told):
        load_run_config(tmp_path / "config.yml")


# -- tensors and arrays ----------------------------------------------------------------------------------------------


class Code:
    """Makes a file wherever it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_checkpoints_run_nothing(tmp_path):
    torch.save({"step": Code(tmp_path / "ran")}, tmp_path / "a.ckpt")
    with pytest.raises(ValueError, match="more than tensors and plain values"):
        load_tensors(tmp_path / "a.ckpt")
    assert not (tmp_path / "ran").exists()


def test_every_reader_of_tensors_refuses_code():
    """No module loads pickles otherwise."""
    root = ROOT / "beags_plugin"
    allowed = {"system/reading/tensors.py"}
    for path in root.rglob("*.py"):
        text = path.read_text("utf8")
        name = path.relative_to(root).as_posix()
        assert name in allowed or not re.search(r"(?<!`)torch\.load\(", text), name
        own = name == "masks/sources/two_stage.py"  # what it has written itself, to a temporary folder
        assert (own or "np.load(" not in text) and "allow_pickle=True" not in text and "pickle.load" not in text, name
        assert "yaml.Loader" not in text and "yaml.full_load" not in text, name


def test_a_tensor_that_a_few_numbers_stand_for_is_refused(tmp_path):
    torch.save({"a": torch.zeros(1).expand(1 << 40)}, tmp_path / "a.pt")
    with pytest.raises(ValueError, match="larger than the file"):
        load_tensors(tmp_path / "a.pt")
    torch.save({"a": torch.zeros(5), "b": [torch.ones(2)]}, tmp_path / "b.pt")
    assert load_tensors(tmp_path / "b.pt")["a"].shape == (5,)


def test_a_checkpoint_of_something_else_is_refused(tmp_path):
    """Found by fuzzing: a bare storage is no table, and says so in an error of its own."""
    from beags_plugin.importers.checkpoint import CheckpointImporter

    for content in (torch.zeros(3).storage(), [1, 2], {"pipeline": 3}, {"pipeline": {1: 2}}):
        torch.save(content, tmp_path / "step-000000001.ckpt")
        with pytest.raises(UserError):
            CheckpointImporter().read(tmp_path / "step-000000001.ckpt")


def packed(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def test_packed_checkpoints_are_refused(tmp_path):
    torch.save({"a": torch.zeros(1000)}, tmp_path / "a.pt")
    with zipfile.ZipFile(tmp_path / "a.pt") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with pytest.raises(ValueError, match="packed"):
        load_tensors(packed(tmp_path / "b.pt", members))


def header(shape: tuple[int, ...], dtype: str = "<f8") -> bytes:
    text = str({"descr": dtype, "fortran_order": False, "shape": shape}).ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


@pytest.mark.parametrize("shape", [(10**15,), (2**40, 2**40), (10, 10), (0, 10**30, 3), (-1,)])
def test_arrays_promise_no_more_than_they_hold(tmp_path, shape):
    (tmp_path / "a.npy").write_bytes(header(shape) + bytes(80))
    with pytest.raises(ValueError, match="cut off|its shape"):
        load_array(tmp_path / "a.npy")


def test_objects_are_not_unpickled(tmp_path):
    np.save(tmp_path / "a.npy", np.array([Code(tmp_path / "ran")], dtype=object))
    with pytest.raises(ValueError, match="holds objects"):
        load_array(tmp_path / "a.npy")
    assert not (tmp_path / "ran").exists()


def test_archives_that_unpack_to_too_much_are_refused(tmp_path):
    bomb = packed(tmp_path / "a.npz", {"a.npy": header((1 << 22,)) + bytes(1 << 25)})
    with zipfile.ZipFile(bomb) as archive:
        assert archive.infolist()[0].file_size > MOST_RATIO * archive.infolist()[0].compress_size
    with pytest.raises(ValueError, match="unpacks to more than"):
        load_arrays(bomb)
    good = np.random.default_rng(0).normal(size=(50, 4))
    np.savez_compressed(tmp_path / "b.npz", good=good)
    assert np.array_equal(load_arrays(tmp_path / "b.npz")["good"], good)


def test_an_archive_whose_list_is_a_lie_is_refused(tmp_path):
    """The list says that a member is longer than the file: 4 GB of a stored one."""
    np.savez(tmp_path / "a.npz", a=np.zeros(3))
    content = (tmp_path / "a.npz").read_bytes()
    at = content.index(b"PK\x01\x02") + 24  # its size in the list
    (tmp_path / "a.npz").write_bytes(content[:at] + struct.pack("<I", 0xFFFFFFF0) + content[at + 4 :])
    with pytest.raises(ValueError, match="longer than the file"):
        load_arrays(tmp_path / "a.npz")


def test_filed_tensors_are_checked(tmp_path):
    file = io.BytesIO()
    write_tensors(file, [torch.arange(3), torch.ones(2, 2)])
    (tmp_path / "a.npz").write_bytes(file.getvalue())
    assert FiledTensors(tmp_path / "a.npz")[0].tolist() == [0, 1, 2]
    content = bytearray(file.getvalue())
    content[content.index(b"(3,)") + 1 : content.index(b"(3,)") + 2] = b"9"
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(ValueError):
        FiledTensors(tmp_path / "a.npz")[0]


# -- pictures, text, COLMAP ------------------------------------------------------------------------------------------


def test_bombs_of_pixels_are_refused(tmp_path):
    huge_png(tmp_path / "a.png")
    with pytest.raises(UserError, match="promises more than 178,956,970 pixels"):
        read_image(tmp_path / "a.png", np.asarray)


def test_only_formats_of_photos_are_opened(tmp_path):
    """Others start programs, as PostScript's does."""
    Image.new("RGB", (4, 4)).save(tmp_path / "a.eps")
    (tmp_path / "a.eps").rename(tmp_path / "a.png")
    Image.open(tmp_path / "a.png").close()  # Pillow would take it
    with pytest.raises(UserError, match="it is none of PNG, JPEG"):
        read_image(tmp_path / "a.png", np.asarray)


def test_deep_json_is_refused(tmp_path):
    (tmp_path / "a.json").write_text('{"a":' * 200_000)
    with pytest.raises(ValueError, match="nested too deeply"):
        load_json(tmp_path / "a.json")


def test_text_that_is_too_long_is_refused_before_it_is_parsed(tmp_path):
    """Also where the system tells no size, as of a pipe; the bound is what such a file may have."""
    path = tmp_path / "a.json"
    path.write_text("[" + "0," * 1000 + "0]")
    assert len(load_json(path, most_bytes=3000)) == 1001
    with pytest.raises(ValueError, match="it is longer than the 0 MB"):
        load_json(path, most_bytes=2001)
    path.write_bytes(b" " * (MOST_BYTES + 1))
    with pytest.raises(UserError, match=r"class names .*a.json cannot be read as JSON \(it is longer than the 16 MB"):
        read_classes(path)
    with pytest.raises(UserError, match="is no TOML .it is longer than the 1 MB that such a file may have"):
        read_toml(path, "preset")
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=lambda: (tmp_path / "pipe").write_bytes(b"[1]"))
    writer.start()
    assert load_json(tmp_path / "pipe") == [1]
    writer.join()


def test_packed_run_lengths_are_counted_as_the_library_unpacks_them():
    from pycocotools import mask

    generator = np.random.default_rng(0)
    for _ in range(50):
        height, width = generator.integers(1, 40, 2)
        picture = np.asfortranarray((generator.random((height, width)) < generator.random()).astype(np.uint8))
        assert packed_total(mask.encode(picture)["counts"].decode()) == height * width
    for wrong in ("~~~~", "o" * 40, "é", "P"):
        with pytest.raises(ValueError):
            packed_total(wrong)


def test_good_models_pass_the_checks(tmp_path):
    write_colmap(tmp_path, points=np.random.default_rng(0).normal(size=(7, 3)))
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        check_colmap_binary(tmp_path / "sparse/0" / name)
        content = (tmp_path / "sparse/0" / name).read_bytes()
        for length in range(0, len(content), 7):
            (tmp_path / name).write_bytes(content[:length])
            with pytest.raises(UserError, match="cut off|no name"):
                check_colmap_binary(tmp_path / name)


def test_a_good_transforms_file_passes(tmp_path):
    write_scene(tmp_path)
    assert read_transforms(tmp_path / "transforms.json") == json.loads((tmp_path / "transforms.json").read_text())


# -- the viewer ------------------------------------------------------------------------------------------------------


def test_viewers_listen_on_this_machine_alone():
    from nerfstudio.configs.base_config import ViewerConfig
    from nerfstudio.scripts.viewer.run_viewer import RunViewer

    from beags_plugin.plugin.presets import load_preset, preset_names

    assert RunViewer(load_config=Path("config.yml")).viewer.websocket_host == "127.0.0.1"  # ns-viewer
    assert {load_preset(name).config.viewer.websocket_host for name in preset_names()} == {"127.0.0.1"}
    assert ViewerConfig().websocket_host == "127.0.0.1" and ViewerConfig().num_rays_per_chunk == 32768
    assert ViewerConfig(websocket_host="0.0.0.0").websocket_host == "0.0.0.0"
