"""The compiled module refuses tensors that a kernel does not read: an error, never a crash."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from beags_plugin.ops import extension

if extension.load() is None:
    pytest.skip("beags_plugin._native was not built", allow_module_level=True)

IMAGE = torch.linspace(0.0, 1.0, 60).view(4, 5, 3)


def photometric(reference, gradient=None):
    return extension.load().photometric_f32(IMAGE, reference, 1e-4, 9e-4, 1.0, 1.0, gradient, 1)


def test_a_contiguous_float32_tensor_is_read_where_it_lies():
    shifted = torch.cat([torch.zeros(1, 5, 3), IMAGE + 0.25])[1:]  # contiguous, but not from its storage's start
    absolute, _ = photometric(shifted)
    assert absolute == pytest.approx(60 * 0.25, rel=1e-6)
    assert photometric(torch.nn.Parameter(shifted)) == photometric(shifted)


def test_results_are_written_where_the_caller_looks():
    gradient = torch.full_like(IMAGE, float("nan"))
    photometric(IMAGE + 0.25, gradient)
    assert gradient.isfinite().all()


@pytest.mark.parametrize(
    "wrong",
    [
        IMAGE.double(),
        IMAGE.int(),
        IMAGE.numpy(),
        IMAGE.tolist(),
        np.float32(1.0),
        None,
        IMAGE.transpose(0, 1),
        IMAGE[:, ::2],
        IMAGE.to("meta"),
        IMAGE.to_sparse(),
    ],
    ids=["float64", "int32", "numpy", "list", "number", "None", "transposed", "strided", "meta", "sparse"],
)
def test_anything_else_is_a_type_error_that_names_what_is_wanted(wrong):
    with pytest.raises(TypeError, match=r"torch.Tensor\[float32, contiguous, cpu\]"):
        photometric(wrong)
    assert photometric(IMAGE)[0] == 0.0  # The call leaves no state behind.


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_a_tensor_on_another_device_is_a_type_error():
    with pytest.raises(TypeError, match="cpu"):
        photometric(IMAGE.cuda())
