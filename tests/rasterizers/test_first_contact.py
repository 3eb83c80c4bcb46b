"""The trial of the CUDA backend before it serves unasked, with backends that fail in every way."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import pytest
import torch
import tried_backends
from cuda_backends import EmulatedCudaRasterizer

from beags_plugin.ops import cuda_extension
from beags_plugin.rasterizers import RASTERIZERS, DeviceDispatchRasterizer, first_contact, make_rasterizer
from beags_plugin.rasterizers.first_contact import Contact, try_in_child, verdict
from beags_plugin.rasterizers.native import NativeRasterizer
from beags_plugin.rasterizers.torch_reference import TorchRasterizer
from beags_plugin.rasterizers.trial import difference
from beags_plugin.system.registry import load

pytestmark = pytest.mark.skipif(NativeRasterizer.unavailable() is not None, reason="the compiled module is not here")


def contact(backend: str = "Agrees", build: str = "1", gpus: str = "NVIDIA X", driver: str = "580.1") -> Contact:
    return Contact(build, gpus, driver, ["cpu"], f"tried_backends:{backend}")


@pytest.fixture(autouse=True)
def fresh(tmp_path, monkeypatch):
    """A cache of its own, and a process that has settled nothing."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv(first_contact.TRUST, raising=False)
    monkeypatch.setattr(cuda_extension, "_refused", [])
    first_contact.settle.cache_clear()
    yield
    first_contact.settle.cache_clear()


@pytest.fixture
def trials(monkeypatch) -> list[str]:
    """The backends tried so far, in this process: what is tested is what becomes of their verdicts."""
    tried: list[str] = []

    def try_here(backend: str, devices) -> str:
        tried.append(backend)
        return difference(load(backend)(), *devices)

    monkeypatch.setattr(first_contact, "try_in_child", try_here)
    return tried


@pytest.mark.parametrize("backend", [NativeRasterizer, TorchRasterizer, EmulatedCudaRasterizer])
def test_backends_that_are_right_agree(backend):
    if reason := backend.unavailable():
        pytest.skip(reason)
    assert difference(backend(), "cpu") == ""


@pytest.mark.parametrize(
    ("backend", "sentence"),
    [
        (tried_backends.DrawsWrongly, "the image depth differs from the torch reference's in float64"),
        (tried_backends.LearnsWrongly, "the gradient quats differs from the torch reference's in float64"),
        (tried_backends.DrawsNothingFinite, "the image alpha differs from the torch reference's in float64"),
        (tried_backends.WrongInFloat32, "the image color differs from the torch reference's in float32"),
    ],
)
def test_what_differs_is_named(backend, sentence):
    assert difference(backend(), "cpu") == sentence


@pytest.mark.slow("each trial is a process that imports torch")
def test_a_child_that_agrees_and_one_that_differs():
    assert try_in_child("tried_backends:Agrees", ["cpu", "cpu"]) == ""
    reason = try_in_child("tried_backends:DrawsWrongly", ["cpu"])
    assert reason == "the image depth differs from the torch reference's in float64"


@pytest.mark.slow("each trial is a process that imports torch")
def test_a_child_that_crashes_or_fails():
    assert try_in_child("tried_backends:Crashes", ["cpu"]) == "rendering a small scene ended with SIGSEGV"
    reason = try_in_child("tried_backends:Raises", ["cpu"])
    illegal = "RuntimeError: CUDA error: an illegal memory access was encountered"
    assert reason == f"rendering a small scene failed ({illegal})"
    assert "No module named 'no_such'" in try_in_child("no_such:Thing", ["cpu"])
    assert try_in_child("tried_backends:Chatters", ["cpu"]).endswith("ended without a result (Bye.)")


@pytest.mark.slow("each trial is a process that imports torch")
def test_a_child_that_hangs_is_ended():
    began = time.monotonic()
    assert try_in_child("tried_backends:Hangs", ["cpu"], 3.0) == "a small scene was not rendered within 3 seconds"
    assert time.monotonic() - began < 60


def test_a_verdict_is_kept_for_this_build_these_gpus_and_this_driver(trials):
    said: list[str] = []
    first = verdict(contact(), say=said.append)
    assert first.reason == "" and first.gpus == "NVIDIA X" and len(trials) == 1
    assert said == ["First use of NVIDIA X by this build: its kernels are compared with the torch reference, once."]
    assert verdict(contact(), say=said.append) == first and len(trials) == 1 and len(said) == 1
    for changed in (contact(build="2"), contact(gpus="NVIDIA Y"), contact(driver="590.2")):
        assert verdict(changed).reason == ""
    assert len(trials) == 4
    assert verdict(contact(), anew=True).reason == "" and len(trials) == 5
    assert len(list(contact().file().parent.iterdir())) == 4


@pytest.mark.usefixtures("trials")
def test_a_bad_verdict_is_kept_too_and_renewed_when_the_build_changes():
    bad = contact("DrawsWrongly")
    assert "image depth differs" in verdict(bad).reason
    mended = replace(bad, backend="tried_backends:Agrees")
    assert "image depth differs" in verdict(mended).reason  # the build is said to be the same
    assert verdict(replace(mended, build="2")).reason == ""
    assert verdict(mended, anew=True).reason == "" and verdict(mended).reason == ""


@pytest.mark.slow("each trial is a process that imports torch")
def test_a_gpu_that_others_have_filled_is_tried_again():
    full = contact("OutOfMemory")
    assert "out of memory" in verdict(full).reason
    assert not full.file().exists()
    assert verdict(replace(full, backend="tried_backends:Agrees")).reason == ""


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"reason": "", "gpus": "X", "seconds": "soon"}'])
def test_a_damaged_verdict_is_made_again(trials, content):
    path = contact().file()
    path.parent.mkdir(parents=True)
    path.write_text(content)
    assert verdict(contact()).reason == "" and len(trials) == 1
    assert json.loads(path.read_text())["driver"] == "580.1"


def test_a_home_that_cannot_be_written_to_keeps_nothing(tmp_path, trials, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert verdict(contact()).reason == "" and len(trials) == 1
    assert verdict(contact()).reason == "" and len(trials) == 2


class Gpu:
    """A machine with a GPU, as far as "auto" looks; ``backend`` takes the trial."""

    def __init__(self, monkeypatch, backend: str) -> None:
        monkeypatch.setattr(cuda_extension, "present", lambda: (object(), None))
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
        monkeypatch.setattr(first_contact, "this_machine", lambda: contact(backend))


@pytest.mark.usefixtures("trials")
def test_auto_takes_a_backend_that_agrees(monkeypatch, capfd):
    Gpu(monkeypatch, "Agrees")
    rasterizer = make_rasterizer("auto")
    assert isinstance(rasterizer, DeviceDispatchRasterizer)
    assert isinstance(rasterizer.gpu, RASTERIZERS.get("cuda")) and isinstance(rasterizer.cpu, NativeRasterizer)
    assert cuda_extension.status()[1] is None
    assert capfd.readouterr().err.count("\n") == 1  # the sentence before the trial


def test_auto_does_without_one_that_fails_and_says_so_once(monkeypatch, capfd):
    Gpu(monkeypatch, "Crashes")
    for _ in range(2):
        rasterizer = make_rasterizer("auto")
        assert isinstance(rasterizer, DeviceDispatchRasterizer)
        assert isinstance(rasterizer.cpu, NativeRasterizer) and isinstance(rasterizer.gpu, TorchRasterizer)
    module, reason = cuda_extension.status()  # No op computes on the GPU either.
    assert module is None and cuda_extension.load() is None
    assert reason is not None and "ended with SIGSEGV" in reason and "the CPU is used instead of NVIDIA X" in reason
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 2 and lines[1] == reason[0].upper() + reason[1:]


@pytest.mark.usefixtures("trials")
def test_the_default_device_is_the_cpu_where_the_trial_fails(monkeypatch):
    machine = pytest.importorskip("beags_plugin.plugin.options.machine")
    Gpu(monkeypatch, "DrawsWrongly")
    assert machine.default_device() == "cpu"
    first_contact.settle.cache_clear()
    monkeypatch.setattr(cuda_extension, "_refused", [])
    monkeypatch.setenv(first_contact.TRUST, "1")
    assert machine.default_device() == "cuda"


def test_a_gpu_that_torch_cannot_open_is_a_verdict(monkeypatch):
    Gpu(monkeypatch, "Agrees")

    def broken():
        raise RuntimeError("CUDA unknown error\nmore")

    monkeypatch.setattr(first_contact, "this_machine", broken)
    assert "torch cannot open it (CUDA unknown error)" in str(first_contact.settle())


def test_there_is_no_trial_without_cuda(trials):
    if cuda_extension.present()[1] is None:
        pytest.skip("there is a GPU")
    assert first_contact.this_machine() is None and first_contact.settle() is None and len(trials) == 0


def test_the_contact_names_build_gpus_and_driver(monkeypatch):
    class Module:
        @staticmethod
        def driver_version() -> int:
            return 13000

    monkeypatch.setattr(cuda_extension, "present", lambda: (Module, None))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda index: f"NVIDIA {index}")
    found = first_contact.this_machine()
    assert found is not None and found.gpus == "NVIDIA 0, NVIDIA 1" and list(found.devices) == ["cuda:0", "cuda:1"]
    assert found.backend.endswith(":CudaRasterizer") and found.driver and len(found.build) == 64
    again = first_contact.this_machine()
    assert again == found
    monkeypatch.setattr(torch, "__version__", "9.9")
    changed = first_contact.this_machine()
    assert changed is not None and changed.build != found.build and changed.file() != found.file()


@pytest.mark.usefixtures("trials")
def test_the_doctor_tries_anew_and_shows_the_verdict(monkeypatch):
    pytest.importorskip("rich")
    from beags_plugin.commands.doctor.backends import first_contact_check

    monkeypatch.setattr(first_contact, "this_machine", lambda: None)
    found = first_contact_check()
    assert not found.ok and not found.required and found.sentence == "none: the CUDA rasterizer cannot run here"
    Gpu(monkeypatch, "DrawsWrongly")
    found = first_contact_check()
    assert not found.ok and not found.required
    assert found.sentence.startswith("the CPU is used instead of NVIDIA X: the image depth differs")
    Gpu(monkeypatch, "Agrees")
    found = first_contact_check()
    assert found.ok and found.sentence.startswith("NVIDIA X draws what the torch reference draws")
    assert verdict(contact("DrawsWrongly")).reason == ""  # The doctor's finding is kept.
