"""Files of any origin run nothing, and do not fill the memory; the viewer of a training listens on this machine."""

from __future__ import annotations

import json
import re
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from places import ROOT

pytest.importorskip("nerfstudio")

from mistakes.photos import huge_png
from run_folders import write_scene, write_trained

from beags_plugin.data.transforms_file import read_transforms
from beags_plugin.masks.sources.coco import packed_total
from beags_plugin.plugin.options.config import config_text
from beags_plugin.plugin.options.saved_config import load_run_config
from beags_plugin.runs import run_config
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.arrays import load_array
from beags_plugin.system.reading.images import read_image
from beags_plugin.system.reading.tensors import load_tensors
from beags_plugin.system.reading.text import load_json

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
    "!!python/object/new:beags_plugin.splat_io.splat_file.SplatFile {{args: [1], state: {{a: 1}}}}",
    "!!python/name:os.system ''",
    "!!python/name:nerfstudio.utils.scripts.run_command ''",
    "!!python/module:os ''",
    "!!python/object:beags_plugin.core.densification.DensifyConfig {{__class__: 1}}",
    "!!python/object/apply:nerfstudio.nowhere.Absent []",
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
    """nerfstudio's loader runs the first of them, so the test above proves something."""
    import yaml

    ran = tmp_path / "ran"
    yaml.load(ATTACKS[0].format(ran=ran), Loader=yaml.Loader)
    assert ran.exists()


def test_configs_of_runs_are_read_as_nerfstudio_reads_them(config):
    import yaml

    text = config.read_text("utf8")
    assert yaml.dump(load_run_config(config)) == yaml.dump(yaml.load(text, Loader=yaml.Loader))


@pytest.mark.parametrize(
    ("now", "former"),
    [
        ("options.stages.DensifyConfig", "core.densification.DensifyConfig"),
        ("options.stages.PreparationConfig", "preparation.pipeline.PreparationConfig"),
    ],
)
def test_classes_that_have_moved_since_are_found_under_their_former_names(config, tmp_path, now, former):
    import yaml

    own = f"!!python/object:beags_plugin.{now}\n"
    text = config.read_text("utf8")
    assert own in text
    (tmp_path / "config.yml").write_text(text.replace(own, f"!!python/object:beags_plugin.{former}\n"), "utf8")
    for read in (load_run_config, lambda path: yaml.load(path.read_text("utf8"), Loader=yaml.Loader)):
        assert yaml.dump(read(tmp_path / "config.yml")) == yaml.dump(load_run_config(config))


def test_paths_in_config_yml_are_words_that_people_edit(config, tmp_path):
    """A long path with a space is one too, and nerfstudio's loader reads it."""
    import yaml

    changed = load_run_config(config)
    changed.data_config.data = Path("/data/my scene") / ("long_" * 30)
    text = config_text(changed)
    assert f"[/data/my scene/{'long_' * 30}]\n" in text and "\n- /\n" not in text
    (tmp_path / "config.yml").write_text(text.replace("my scene", "your scene"))
    for read in (load_run_config(tmp_path / "config.yml"), yaml.load(text.replace("my", "your"), Loader=yaml.Loader)):
        assert read.data_config.data.parent == Path("/data/your scene")


def test_a_saved_config_names_no_folder_but_those_that_were_given(tmp_path, monkeypatch):
    """The data parser's default folder would be the one that ns-train was called in."""
    from beags_plugin.plugin.presets import preset_config

    (tmp_path / "called_here").mkdir()
    monkeypatch.chdir(tmp_path / "called_here")
    config = preset_config("beags-tiny", {}, tmp_path / "run")
    config.run_dir, config.data_config.data = tmp_path / "run", tmp_path / "lab"
    config.save_config()
    text = (tmp_path / "run/config.yml").read_text("utf8")
    assert text.count(f"[{tmp_path / 'lab'}]") >= 2 and f"[{tmp_path / 'called_here'}]" not in text


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
    """No other module loads pickles."""
    root = ROOT / "beags_plugin"
    allowed = {"system/reading/tensors.py"}
    for path in root.rglob("*.py"):
        text = path.read_text("utf8")
        name = path.relative_to(root).as_posix()
        assert name in allowed or not re.search(r"(?<!`)torch\.load\(", text), name
        own = name == "masks/sources/two_stage.py"  # it reads its own temporary files
        assert (own or "np.load(" not in text) and "allow_pickle=True" not in text and "pickle.load" not in text, name
        read = re.sub(r"yaml\.add_constructor\(.*\)", "", text)  # Nerfstudio itself reads these.
        assert "yaml.Loader" not in read and "yaml.full_load" not in read, name


def test_numpy_scalars_of_nerfstudios_schedulers_load_and_nothing_else_changes(tmp_path):
    state = {"lr": np.float64(0.25), "base": np.float32(0.5)}
    torch.save(state, tmp_path / "a.ckpt")
    before = set(map(str, torch.serialization.get_safe_globals()))
    assert load_tensors(tmp_path / "a.ckpt") == state
    assert set(map(str, torch.serialization.get_safe_globals())) == before
    assert not any("numpy" in name for name in before), "importing the plugin changes what torch loads for all"


def test_a_tensor_that_a_few_numbers_stand_for_is_refused(tmp_path):
    torch.save({"a": torch.zeros(1).expand(1 << 40)}, tmp_path / "a.pt")
    with pytest.raises(ValueError, match="larger than the file"):
        load_tensors(tmp_path / "a.pt")
    torch.save({"a": torch.zeros(5), "b": [torch.ones(2)]}, tmp_path / "b.pt")
    assert load_tensors(tmp_path / "b.pt")["a"].shape == (5,)


def test_a_checkpoint_of_something_else_is_refused(tmp_path):
    """Fuzzing found that a bare storage is no table and raises an error of its own."""
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


def test_an_archive_whose_list_is_a_lie_is_refused(tmp_path):
    """The list says that a stored member has 4 GB, more than the file."""
    torch.save(torch.zeros(3), tmp_path / "a.pt")
    content = (tmp_path / "a.pt").read_bytes()
    at = content.index(b"PK\x01\x02") + 24  # its size in the list
    (tmp_path / "a.pt").write_bytes(content[:at] + struct.pack("<I", 0xFFFFFFF0) + content[at + 4 :])
    with pytest.raises(ValueError, match="longer than the file"):
        load_tensors(tmp_path / "a.pt")


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


# -- pictures and text ------------------------------------------------------------------------------------------


def test_bombs_of_pixels_are_refused(tmp_path):
    huge_png(tmp_path / "a.png")
    with pytest.raises(UserError, match="promises more than 178,956,970 pixels"):
        read_image(tmp_path / "a.png", np.asarray)


def test_only_formats_of_photos_are_opened(tmp_path):
    """Others start programs, as PostScript does."""
    Image.new("RGB", (4, 4)).save(tmp_path / "a.eps")
    (tmp_path / "a.eps").rename(tmp_path / "a.png")
    Image.open(tmp_path / "a.png").close()  # Pillow would take it
    with pytest.raises(UserError, match="it is none of PNG, JPEG"):
        read_image(tmp_path / "a.png", np.asarray)


def test_deep_json_is_refused(tmp_path):
    (tmp_path / "a.json").write_text('{"a":' * 200_000)
    with pytest.raises(ValueError, match="nested too deeply"):
        load_json(tmp_path / "a.json")


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


def test_a_good_transforms_file_passes(tmp_path):
    write_scene(tmp_path)
    assert read_transforms(tmp_path / "transforms.json") == json.loads((tmp_path / "transforms.json").read_text())


# -- the viewer ------------------------------------------------------------------------------------------------------


def test_our_trainings_listen_on_this_machine_alone():
    from beags_plugin.plugin.presets import load_preset, preset_names

    assert {load_preset(name).config.viewer.websocket_host for name in preset_names()} == {"127.0.0.1"}
