"""The default device of a run, and a whole training in two processes through nerfstudio's launcher."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import torch.distributed as dist

pytest.importorskip("nerfstudio")

from nerfstudio.configs.base_config import MachineConfig
from training_in_processes import train_in_two

from beags_plugin.ops import cuda_extension
from beags_plugin.plugin.options.machine import check_machine
from beags_plugin.plugin.presets import preset_config, preset_names
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.cuda import CudaRasterizer
from beags_plugin.rasterizers.device_dispatch import DeviceDispatchRasterizer
from beags_plugin.rasterizers.torch_reference import TorchRasterizer
from beags_plugin.sample.writer import SampleConfig, write_sample
from beags_plugin.system.errors import UserError


@pytest.fixture
def two_gpus(monkeypatch):
    """A machine with two GPUs, as far as questions go."""
    monkeypatch.setattr(cuda_extension, "status", lambda: (SimpleNamespace(EMULATED=False), None))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)


@pytest.fixture
def no_gpu(monkeypatch):
    monkeypatch.setattr(cuda_extension, "status", lambda: (None, "torch finds no CUDA device."))


def device_of(preset: str) -> str:
    return preset_config(preset, {}, Path("test")).machine.device_type


def test_presets_train_on_a_gpu_where_its_kernels_can_run(two_gpus):
    assert {device_of(name) for name in preset_names()} == {"cuda"}
    rasterizer = make_rasterizer("auto")
    assert isinstance(rasterizer, DeviceDispatchRasterizer) and isinstance(rasterizer.gpu, CudaRasterizer)
    on_gpu = SimpleNamespace(means=SimpleNamespace(is_cuda=True))
    on_cpu = SimpleNamespace(means=SimpleNamespace(is_cuda=False))
    assert rasterizer._backend(on_gpu) is rasterizer.gpu and rasterizer._backend(on_cpu) is rasterizer.cpu


def test_presets_train_on_the_cpu_elsewhere(no_gpu):
    assert {device_of(name) for name in preset_names()} == {"cpu"}
    assert not isinstance(make_rasterizer("auto"), DeviceDispatchRasterizer)


def test_a_gpu_without_our_kernels_is_drawn_on_by_torch(no_gpu, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    rasterizer = make_rasterizer("auto")
    assert isinstance(rasterizer, DeviceDispatchRasterizer) and isinstance(rasterizer.gpu, TorchRasterizer)


def test_devices_are_checked(two_gpus):
    for count in (1, 2):
        check_machine(MachineConfig(device_type="cuda", num_devices=count))
    check_machine(MachineConfig(device_type="cpu"))
    with pytest.raises(UserError, match="nerfstudio starts several processes for GPUs only"):
        check_machine(MachineConfig(device_type="cpu", num_devices=2))
    with pytest.raises(UserError, match=r"--machine.num-devices is 3, but this machine has 2 GPU\(s\)"):
        check_machine(MachineConfig(device_type="cuda", num_devices=3))


def test_a_gpu_that_is_not_there_ends_the_program_with_a_sentence(no_gpu, capsys):
    with pytest.raises(UserError, match="torch finds no CUDA device. Or train with --machine.device-type cpu"):
        check_machine(MachineConfig(device_type="cuda"))
    config = preset_config("beags", {}, Path("test"))
    config.machine.device_type = "cuda"
    with pytest.raises(SystemExit) as end:
        config.set_timestamp()
    output = " ".join(capsys.readouterr().out.split())
    assert end.value.code == 2 and "--machine.device-type cuda: torch finds no" in output


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """A short run of all phases in two processes: its folder, and what each process had."""
    out = tmp_path_factory.mktemp("several")
    write_sample(out / "data", SampleConfig(seed=3, width=48, height=36, num_train=7, num_test=2, exposure=1.5))
    train_in_two(out / "data", out)
    return out, [json.loads((out / f"rank{rank}.json").read_text()) for rank in (0, 1)]


needs_gloo = pytest.mark.skipif(not dist.is_gloo_available(), reason="torch was built without gloo")


@needs_gloo
def test_both_processes_have_the_same_scene_after_growth_and_refinement(two):
    _, (first, second) = two
    assert first["counts"] == second["counts"] and len(set(first["counts"])) > 2  # it has grown, and alike
    for name in set(first["end"]) - {"folder"}:
        assert first["end"][name] == second["end"][name], name
    assert {"_model.gauss_params.means", "_model.class_ids", "adam"} <= set(first["end"])
    assert first["end"]["exposures"] is not None


@needs_gloo
def test_both_processes_learn_the_same_codes(tmp_path):
    write_sample(tmp_path / "data", SampleConfig(seed=3, width=48, height=36, num_train=7, num_test=2))
    changes = {"refiner": "gaussian-grouping", "prepare.reprojection": "none"}
    train_in_two(tmp_path / "data", tmp_path, **{f"pipeline.model.{name}": value for name, value in changes.items()})
    first, second = (json.loads((tmp_path / f"rank{rank}.json").read_text())["end"] for rank in (0, 1))
    for name in ("own", "_model.gauss_params.means", "_model.class_ids"):
        assert first[name] == second[name], name


@needs_gloo
def test_each_process_renders_views_of_its_own(two):
    _, (first, second) = two
    together = [view for pair in zip(first["views"], second["views"], strict=True) for view in pair]
    assert all(len(set(together[start : start + 7])) == 7 for start in range(0, 42, 7))  # rounds of all seven views


@needs_gloo
def test_only_the_first_process_writes_into_the_run(two):
    out, (first, second) = two
    run = out / "run"
    assert first["end"]["folder"] == str(run) and second["end"]["folder"] != str(run)
    assert first["end"]["run"] == second["end"]["run"] == str(run)
    assert not Path(second["end"]["folder"]).exists()
    assert (run / "training.json").exists() and (run / "prepared" / "grid.pt").exists()
    (checkpoint,) = (run / "nerfstudio_models").iterdir()
    state = torch.load(checkpoint, weights_only=True)
    assert len(state["pipeline"]["_model.gauss_params.means"]) == first["counts"][-1]
