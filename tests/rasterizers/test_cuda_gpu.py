"""Parts of the CUDA backend that only a GPU can show: streams, waiting, devices."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from raster_scenes import make_scene

from beags_plugin.rasterizers import DeviceDispatchRasterizer, make_rasterizer
from beags_plugin.rasterizers.cuda import CudaRasterizer
from beags_plugin.rasterizers.interface import SurfelInputs

pytestmark = pytest.mark.skipif(CudaRasterizer.unavailable() is not None, reason=str(CudaRasterizer.unavailable()))


def on_gpu(scene):
    values = {name: value.float().cuda() for name, value in vars(scene.inputs).items() if value is not None}
    values["class_ids"] = scene.inputs.class_ids.cuda()
    return replace(
        scene,
        inputs=SurfelInputs(**values),
        camera=scene.camera.to("cuda"),
        background=scene.background.float().cuda(),
        target=scene.target.cuda(),
    )


def test_auto_renders_where_the_surfels_lie_cuda():
    scene = make_scene().to(torch.float32)
    rasterizer = make_rasterizer("auto")
    assert isinstance(rasterizer, DeviceDispatchRasterizer)
    there, here = on_gpu(scene).draw(rasterizer), scene.draw(rasterizer)
    assert there.color.is_cuda and not here.color.is_cuda
    assert (there.color.cpu() - here.color).abs().max() < 1e-3


def test_another_stream_gives_the_same_bits_cuda():
    scene, rasterizer = on_gpu(make_scene()), CudaRasterizer()
    expected = scene.draw(rasterizer).color
    torch.cuda.synchronize()
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        found = scene.draw(rasterizer).color
    stream.synchronize()
    assert torch.equal(found, expected)


def test_a_training_step_makes_the_host_wait_for_no_copy_cuda():
    """In this mode torch raises where it waits itself; ``CudaRasterizer`` waits for an event instead."""
    from beags_benchmarks.kernels.scenes import Size, make_scene, on_device
    from beags_benchmarks.kernels.training_step import TrainingStep

    step = TrainingStep(on_device(make_scene(Size(2_000, 130, 100)), "cuda"), 20, CudaRasterizer())
    for _ in range(3):
        step.run()
    torch.cuda.set_sync_debug_mode("error")
    try:
        step.run()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert step.step == 4 and all(value.grad.isfinite().all() for value in step.parameters.values())


def test_tensors_on_the_cpu_are_refused_cuda():
    with pytest.raises(ValueError, match="tensors on a GPU"):
        make_scene().draw(CudaRasterizer())


def test_thousands_of_tiles_and_large_surfels_cuda():
    """A scene that fills every multiprocessor many times: the same bits twice, and alpha as the reference has it."""
    scene = make_scene(count=5000, width=640, height=480, seed=9, size=-2.0)
    scene = replace(scene, camera=replace(scene.camera, K=scene.camera.K * torch.tensor([[16.0], [16.0], [1.0]])))
    there, rasterizer = on_gpu(scene), CudaRasterizer()
    first, again = there.draw(rasterizer), there.draw(rasterizer)
    assert torch.equal(first.color, again.color) and torch.equal(first.normal, again.normal)
    expected = scene.to(torch.float32).draw(make_rasterizer("native"))
    assert ((first.alpha.cpu() - expected.alpha).abs() > 1e-3).float().mean() < 1e-3
