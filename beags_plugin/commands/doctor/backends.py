"""Checks that the rasterizers render."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable

from beags_plugin.commands.doctor.check import Check, first_line

REBUILD = "pip install --force-reinstall --no-deps ."
"""Command that rebuilds the compiled backend; it runs in the folder of the clone."""


def rasterizers() -> list[Callable[[], Check]]:
    """Return a check of every backend that is registered."""
    try:
        from beags_plugin.rasterizers import RASTERIZERS
    except Exception as error:
        sentence = f"cannot be listed: {first_line(error)}"
        return [lambda: Check("rasterizers", False, sentence)]
    return [lambda name=name: rasterizer(name) for name in RASTERIZERS.names()]


def rasterizer(name: str) -> Check:
    """Check a backend by rendering in a process of its own, so that a crash does not end the doctor."""
    title, required = f"rasterizer {name}", name == "torch"
    done = subprocess.run(
        [sys.executable, "-c", TRIAL, json.dumps(sys.path), name], capture_output=True, text=True, timeout=120
    )
    if done.returncode < 0:
        sentence = f"it ends with {signal.Signals(-done.returncode).name}: it is damaged, or made for another machine"
    elif done.returncode != 0 or not done.stdout.strip():
        sentence = f"it fails when it renders: {(done.stderr.strip().splitlines() or ['no message'])[-1]}"
    else:
        ok, sentence, absent = json.loads(done.stdout.strip().splitlines()[-1])
        if absent and name == "native":
            sentence = f"{sentence.rstrip('.')}; until then the torch reference renders, some hundred times slower"
        return Check(title, ok, sentence, required, REBUILD if absent and name == "native" else "")
    avoided = "" if required else f"; {_AVOIDED.get(name, '--pipeline.model.rasterizer torch avoids it')}"
    return Check(title, False, sentence + avoided, required, REBUILD)


def first_contact_check() -> Check:
    """Check anew that the CUDA backend agrees with the torch reference, and store the verdict."""
    from beags_plugin.rasterizers import first_contact

    name, contact = "CUDA trial", first_contact.this_machine()
    if contact is None:
        return Check(name, False, "none: the CUDA rasterizer cannot run here", False)
    verdict = first_contact.verdict(contact, anew=True)
    if verdict.reason:
        return Check(name, False, first_contact.refusal(verdict), False)
    return Check(name, True, f"{verdict.gpus} draws what the torch reference draws ({verdict.seconds:g} s)", False)


_AVOIDED = {  # Ways to run without a failing backend.
    "native": "BEAGS_NATIVE=0 in the environment avoids it",
    "cuda": "training with --machine.device-type cpu avoids it",
}

# This program renders one Gaussian, forward and backward: code for another processor fails only when it runs.
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
    assert render.alpha.max() > 0.1, "it renders nothing"
    native = sys.modules.get("beags_plugin._native") if name == "native" else None
    kernels = f", with {native.instruction_set()} kernels" if native else ""
    print(json.dumps([True, "can run here" + kernels, False]))
except UserError as error:
    # With a reason "auto" uses another backend; without one (a missing instruction set is requested) nothing runs.
    print(json.dumps([False, reason or str(error), reason is not None]))
"""
