"""A process that measures on request: it reads JSON requests and writes JSON answers, one in each line.

A process chooses its instruction set once (environment variable BEAGS_ISA), so each set needs its own process; peak
memory needs a new process for each case.
"""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from beags_benchmarks.provenance import with_these_packages

Timings = list[tuple[float, float]]  # milliseconds of wall and CPU time, one pair a call
MAX_CALLS = 40  # most calls of one entry in one round
SMALL = "64/32x32"  # a case that only loads code and starts threads


class Worker:
    """The client of a worker process. isa: forced instruction set, or None for the best one."""

    def __init__(self, isa: str | None = None) -> None:
        environment = with_these_packages(os.environ)
        environment.pop("BEAGS_ISA", None)
        # Spinning idle threads would take cores from the process that is measured.
        environment.setdefault("OMP_WAIT_POLICY", "PASSIVE")
        if isa is not None:
            environment["BEAGS_ISA"] = isa
        self._process = subprocess.Popen(
            [sys.executable, "-m", "beags_benchmarks.kernels.worker"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip

    def ask(self, do: str, **arguments: Any) -> Any:
        """Send a request and return the answer; raises ``RuntimeError`` with the worker's error, or if it ended."""
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            print(json.dumps({"do": do, **arguments}), file=self._process.stdin, flush=True)
            line = self._process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            raise RuntimeError(f"the measuring process ended with code {self._process.wait()}")
        answer = json.loads(line)
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer["value"]

    def close(self) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait()

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def main() -> None:
    """Answer until the input ends."""
    # Output of libraries goes to stderr, so that it does not mix with the answers.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer = {"value": _ANSWERS[request.pop("do")](**request)}
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers, flush=True)


def _hello(names: list[str]) -> dict[str, Any]:
    """Return what this process can measure: instruction sets, and per backend None or the reason that it cannot run."""
    import torch

    from beags_benchmarks.kernels import backends
    from beags_plugin.rasterizers import RASTERIZERS, native

    reasons = {name: RASTERIZERS.get(name).unavailable() for name in names}
    known = reasons.get("native", "") is None
    for name, reason in reasons.items():
        if reason is None:
            backends.run(name, _scene(SMALL))  # costs that occur once in a process
    return {
        "torch": torch.__version__,
        "reasons": reasons,
        "isa": native.instruction_set() if known else None,
        "isas": native.instruction_sets() if known else [],
    }


def _time(size: str, backend: str, threads: int, seconds: float) -> dict[str, Timings]:
    """Measure forward and backward, call by call, for about ``seconds`` and at least once."""
    from beags_benchmarks.kernels import backends

    _set_threads(threads)
    scene = _scene(size)
    timings: dict[str, Timings] = {"forward": [], "backward": []}
    for _ in _calls(seconds):
        forward, backward, _, _ = backends.run(backend, scene)
        timings["forward"].append(forward.ms())
        timings["backward"].append(backward.ms())
    return timings


def _stages(size: str, threads: int, seconds: float) -> Timings:
    """Measure only the first stage of the native forward: projection and binning."""
    from beags_benchmarks.kernels import backends
    from beags_benchmarks.kernels.clock import Seconds
    from beags_plugin.rasterizers import native

    _set_threads(threads)
    scene = _scene(size)
    inputs, timings = backends.surfel_inputs(scene), []
    for _ in _calls(seconds):
        start = Seconds.now()
        native._frame(inputs, scene.camera, scene.settings)
        timings.append((Seconds.now() - start).ms())
    return timings


def _step(
    size: str, threads: int, seconds: float, samples: int | None = None, parts: bool = False
) -> dict[str, Timings]:
    """Measure whole training steps ("step"), or the parts of steps."""
    _set_threads(threads)
    step = _training_step(size, samples)
    timings: dict[str, Timings] = {}
    for _ in _calls(seconds):
        for name, value in (step.run_parts() if parts else {"step": step.run()}).items():
            timings.setdefault(name, []).append(value.ms())
    return timings


def _digest(size: str, threads: int) -> str:
    """Return a hash of all images and gradients of the native rasterizer."""
    from beags_benchmarks.kernels import backends

    _set_threads(threads)
    _, _, images, gradients = backends.run("native", _scene(size))
    return backends.digest(*images.values(), *gradients.values())


def _describe(size: str) -> dict[str, Any]:
    """Return the median width of the scene's surfels in pixels, and the native rasterizer's work, or None."""
    from beags_benchmarks.kernels import backends, scenes

    scene = _scene(size)
    return {"median_width": scenes.median_width(scene), "work": backends.work_counts(scene)}


def _sampled(size: str) -> float:
    return _training_step(size, 20).sampled_share()


def _peak(size: str, threads: int, backend: str | None = None, samples: int | None = None) -> float:
    """Return the MB of a forward and backward (without a backend: a training step) beyond scene and libraries."""
    from beags_benchmarks.kernels import backends
    from beags_benchmarks.kernels.peak_memory import peak_mb_of
    from beags_benchmarks.kernels.training_step import TrainingStep

    _set_threads(threads)
    if backend is None:
        TrainingStep(_scene(SMALL), samples).run()
        step = _training_step(size, samples)
        step.run()  # Adam's moments belong to the scene, not to the step
        return peak_mb_of(step.run)
    scene = _scene(size)
    backends.run(backend, _scene(SMALL))
    return peak_mb_of(lambda: backends.run(backend, scene))


def _calls(seconds: float):
    """Yield the number of each call until the time is over, at least once."""
    end = time.perf_counter() + seconds
    gc.collect()
    for call in range(MAX_CALLS):
        yield call
        if time.perf_counter() >= end:
            return


def _set_threads(threads: int) -> None:
    import torch

    torch.set_num_threads(threads)


@lru_cache(maxsize=8)
def _scene(size: str):
    from beags_benchmarks.kernels.scenes import make_scene, parse_size

    return make_scene(parse_size(size))


@lru_cache(maxsize=8)
def _training_step(size: str, samples: int | None):
    from beags_benchmarks.kernels.training_step import TrainingStep

    return TrainingStep(_scene(size), samples)


_ANSWERS: dict[str, Callable[..., Any]] = {
    "hello": _hello,
    "time": _time,
    "stages": _stages,
    "step": _step,
    "digest": _digest,
    "describe": _describe,
    "sampled": _sampled,
    "peak": _peak,
}

if __name__ == "__main__":
    main()
