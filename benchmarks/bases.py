"""Trained bases to measure on, each trained once."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

from beags_plugin.system.child_processes import bound
from beags_plugin.system.errors import UserError

STAMP = "trained.json"


def trained_base(data: Path, run: Path, preset: str) -> Path:
    """Return the config.yml of the preset's base phase on ``data``; train it into ``run`` unless it is there.

    Raises ``UserError`` if the training fails.
    """
    request = {"preset": preset, "data": str(data.absolute())}
    stamp = run.with_name(run.name + "." + STAMP)
    if (run / "config.yml").exists() and stamp.exists() and json.loads(stamp.read_text()) == request:
        return run / "config.yml"
    stamp.unlink(missing_ok=True)
    shutil.rmtree(run, ignore_errors=True)
    command = [
        str(Path(sys.executable).parent / "ns-train"), preset, "--data", str(data), "--run-dir", str(run.absolute()),
        "--vis", "tensorboard", "--pipeline.model.refine-steps", "0", "beags-data", "--downscale-factor", "1",
    ]  # fmt: skip
    code = subprocess.run(bound(command)).returncode
    if code != 0:
        raise UserError(f"training ended with exit code {code}; what it printed above says why.")
    stamp.write_text(json.dumps(request))
    return run / "config.yml"
