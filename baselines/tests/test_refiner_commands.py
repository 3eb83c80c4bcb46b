"""A refiner and its options on the command line: ns-train, and what extract and export make of the run."""

from __future__ import annotations

import pytest
from called_programs import called
from run_folders import write_scene

pytest.importorskip("nerfstudio")

from beags_plugin.core.membership import Membership
from beags_plugin.runs.read import read_run
from beags_plugin.runs.relocation import open_run
from beags_plugin.system.reading.ply import read_vertices

pytestmark = pytest.mark.slow("two trainings by ns-train")

TRAIN = (
    "ns-train", "beags-tiny", "--vis", "tensorboard", "--machine.device-type", "cpu",
    "--optimizers.opacities.optimizer.lr", 0.5, "--pipeline.model.prepare.reprojection", "none",
    "--pipeline.model.refiner", "flashsplat",
)  # fmt: skip


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A run with gamma -0.9, and one from its base without options."""
    root = tmp_path_factory.mktemp("commands")
    data, biased, plain = write_scene(root / "data"), root / "biased", root / "plain"
    options = "--pipeline.model.base-steps", 30, "--pipeline.model.refiner-options", "gamma", -0.9
    called(*TRAIN, "--data", data, "--run-dir", biased, *options)
    base = "--load-dir", biased / "base/nerfstudio_models", "--pipeline.model.base-steps", 0
    called(*TRAIN, "--data", data, "--run-dir", plain, *base)
    return biased, plain


def members_of(run) -> Membership:
    return read_run(run / "config.yml").members


def test_the_option_decides_who_is_a_member(runs):
    biased, plain = runs
    config = open_run(biased / "config.yml").model_config
    assert (config.refiner, config.refiner_options) == ("flashsplat", {"gamma": -0.9})
    more, fewer = members_of(biased), members_of(plain)
    assert (more.of(1) & more.of(2)).any() and not (fewer.of(1) & fewer.of(2)).any()
    for class_id in (1, 2):
        assert not (fewer.of(class_id) & ~more.of(class_id)).any()
        assert 0 < int(fewer.of(class_id).sum()) < int(more.of(class_id).sum())


@pytest.mark.parametrize("index", [0, 1])
def test_commands_write_these_members(runs, tmp_path, index):
    load = "--load-config", runs[index] / "config.yml"
    called("beags", "extract", *load, "--keep-all", "--output", tmp_path / "extracted")
    called("beags", "export", *load, "--keep-all", "--all", "--output", tmp_path / "exports")
    members = members_of(runs[index])
    for class_id, name in ((1, "cup"), (2, "box")):
        count = int(members.of(class_id).sum())
        (extracted,) = (tmp_path / "extracted" / name).glob("*.ply")
        assert len(read_vertices(extracted)) == len(read_vertices(tmp_path / f"exports/{name}.ply")) == count
        assert members_of(tmp_path / "extracted" / name).present() == [class_id]
