"""The CUDA part is used where it can be, and a sentence explains where it cannot."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from beags_plugin.ops import cuda_extension, extension


@pytest.fixture
def found(monkeypatch):
    """``cuda_extension.present`` on a machine with a GPU; driver, needed: CUDA versions, as CUDA counts."""

    def ask(driver: int, needed: int):
        cuda = SimpleNamespace(driver_version=lambda: driver, needed_driver_version=lambda: needed)
        monkeypatch.setattr(extension, "status", lambda: (SimpleNamespace(cuda=cuda), None))
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
        module, reason = cuda_extension.present.__wrapped__()
        assert (module is cuda) == (reason is None)
        return reason

    return ask


def test_a_driver_that_is_new_enough_will_do(found):
    assert found(13000, 13000) is None and found(13020, 13000) is None


def test_a_driver_that_is_too_old_is_named(found):
    reason = found(12060, 13000)
    assert "supports CUDA up to 12.6" in reason and "nvcc for 13.0 or newer" in reason
    assert found(13000, 13020) is not None  # the driver compiles PTX


def test_a_module_without_kernels_says_how_to_get_them(monkeypatch):
    monkeypatch.setattr(extension, "status", lambda: (SimpleNamespace(), None))
    assert "install the CUDA toolkit" in cuda_extension.present.__wrapped__()[1]


def test_what_is_refused_is_not_used_though_it_is_there(monkeypatch):
    module = SimpleNamespace()
    monkeypatch.setattr(cuda_extension, "present", lambda: (module, None))
    monkeypatch.setattr(cuda_extension, "_refused", [])
    assert cuda_extension.load() is module
    cuda_extension.refuse("it draws nonsense.")
    assert cuda_extension.status() == (None, "it draws nonsense.") and cuda_extension.load() is None
