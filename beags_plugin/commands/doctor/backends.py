"""Checks that the rasterizers render."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace

from beags_plugin.commands.doctor.check import Check, first_line

REBUILD = "pip install --force-reinstall --no-deps ."
"""In the folder of the clone: builds the compiled backend anew."""


def rasterizers() -> list[Callable[[], Check]]:
    """Return a check of every backend that is registered."""
    try:
        from beags_plugin.rasterizers import RASTERIZERS

        names = RASTERIZERS.names()
    except Exception as error:
        sentence = f"cannot be listed: {first_line(error)}"
        return [lambda: Check("rasterizers", False, sentence)]
    return [lambda name=name: rasterizer(name) for name in names]


def rasterizer(name: str) -> Check:
    """Check whether a backend can run; all but the torch one are tried."""
    from beags_plugin.rasterizers import RASTERIZERS

    title, required = f"rasterizer {name}", name == "torch"
    try:
        if not required:
            return replace(_try_in_process(name), name=title, required=False)
        reason = RASTERIZERS.get(name).unavailable()
    except Exception as error:
        return Check(title, False, first_line(error), required)
    return Check(title, reason is None, reason or "can run here", required)


# Draws one surfel, there and back: code for another processor is found only when it runs.
TRIAL = """
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from beags_plugin.system.errors import UserError
from beags_plugin.rasterizers import RASTERIZERS, make_rasterizer
name = sys.argv[2]
reason = None
try:
    reason = RASTERIZERS.get(name).unavailable()
    rasterizer = make_rasterizer(name)
    import torch
    from beags_plugin.core.cameras import Camera
    from beags_plugin.rasterizers.interface import RasterSettings, SurfelInputs
    K = torch.tensor([[9.0, 0.0, 4.0], [0.0, 9.0, 4.0], [0.0, 0.0, 1.0]])
    values = (torch.tensor([[0.0, 0.0, 1.0]]), torch.ones(1, 4), torch.full((1, 2), -2.0), torch.zeros(1),
              torch.ones(1, 3), torch.zeros(3))
    *values, background = (value.to("cuda" if name.startswith("cuda") else "cpu") for value in values)
    inputs = SurfelInputs(values[0].requires_grad_(), *values[1:])
    render = rasterizer.rasterize(inputs, Camera(torch.eye(4), K, 8, 8), RasterSettings(0.1, 9.0), background)
    render.color.sum().backward()
    assert render.alpha.max() > 0.1, "it draws nothing"
    native = sys.modules.get("beags_plugin._native") if name == "native" else None
    kernels = f", with {native.instruction_set()} kernels" if native else ""
    print(json.dumps([True, "can run here" + kernels, False]))
except UserError as error:
    # with a reason "auto" draws with another backend; an instruction set that was asked for in vain stops everything
    print(json.dumps([False, reason or str(error), reason is not None]))
"""


_AVOIDED = {  # how to do without a backend that fails
    "native": "BEAGS_NATIVE=0 in the environment avoids it",
    "cuda": "training with --machine.device-type cpu avoids it",
}


def _try_in_process(name: str) -> Check:
    """Draw with the backend in a process of its own, which may die without taking the doctor along."""
    avoided = _AVOIDED.get(name, "--pipeline.model.rasterizer torch avoids it")
    done = subprocess.run(
        [sys.executable, "-c", TRIAL, json.dumps(sys.path), name], capture_output=True, text=True, timeout=120
    )
    if done.returncode < 0:
        processor, killer = "GPU" if name.startswith("cuda") else "processor", signal.Signals(-done.returncode).name
        cause = f"it ends with {killer}, so it is damaged or made for another {processor}"
        sentence = f"{cause}: reinstall beags from source; {avoided}"
        return Check(name, False, sentence, repair=REBUILD)
    lines = done.stdout.strip().splitlines()
    if done.returncode != 0 or not lines:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        sentence = f"it fails when it draws: {last}; {avoided}"
        return Check(name, False, sentence, repair=REBUILD)
    ok, sentence, replaced = json.loads(lines[-1])
    if replaced and name == "native":
        sentence = f"{sentence.rstrip('.')}; until then the torch reference draws, some hundred times slower"
    return Check(name, ok, sentence, repair=REBUILD if replaced and name == "native" else "")
