"""Backends for trials: the compiled one, which agrees with the torch reference, and it failing in every way."""

from __future__ import annotations

import atexit
import os
import signal
import time
from dataclasses import replace

from beags_plugin.rasterizers.native import NativeRasterizer


class Agrees(NativeRasterizer):
    pass


class DrawsWrongly(NativeRasterizer):
    def rasterize(self, *args, **kwargs):
        drawn = super().rasterize(*args, **kwargs)
        return replace(drawn, depth=drawn.depth * 1.001)


class LearnsWrongly(NativeRasterizer):
    def rasterize(self, inputs, *args, **kwargs):
        return super().rasterize(replace(inputs, quats=inputs.quats.detach() + 0 * inputs.quats), *args, **kwargs)


class DrawsNothingFinite(NativeRasterizer):
    def rasterize(self, *args, **kwargs):
        drawn = super().rasterize(*args, **kwargs)
        return replace(drawn, alpha=drawn.alpha / 0.0)


class WrongInFloat32(NativeRasterizer):
    def rasterize(self, inputs, *args, **kwargs):
        drawn = super().rasterize(inputs, *args, **kwargs)
        return drawn if inputs.means.element_size() == 8 else replace(drawn, color=drawn.color + 0.01)


class Crashes(NativeRasterizer):
    def rasterize(self, *args, **kwargs):
        os.kill(os.getpid(), signal.SIGSEGV)


class Hangs(NativeRasterizer):
    def rasterize(self, *args, **kwargs):
        time.sleep(600)


class Raises(NativeRasterizer):
    def rasterize(self, *args, **kwargs):
        raise RuntimeError("CUDA error: an illegal memory access was encountered\nand more")


class OutOfMemory(NativeRasterizer):
    def rasterize(self, *args, **kwargs):
        raise RuntimeError("CUDA error: out of memory\nFor debugging consider passing CUDA_LAUNCH_BLOCKING=1")


class Chatters(NativeRasterizer):
    def __init__(self) -> None:
        super().__init__()
        atexit.register(print, "Bye.")
