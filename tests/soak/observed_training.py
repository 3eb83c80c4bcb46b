"""ns-train as it is, and beside it a record of what its process holds: memory, threads, open files, child processes.

python observed_training.py RECORD EVERY ARGUMENTS OF NS-TRAIN: RECORD gets a line of JSON for every EVERY-th step, one
from before the run and one from after it (Linux). Nothing is kept in the process itself.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from nerfstudio.scripts.train import entrypoint

from beags_plugin.plugin.trainer import BeagsTrainer
from beags_plugin.system.memory import memory_mb


def held(step: int | None, phase: str) -> dict[str, Any]:
    """Return what this process holds: resident MB (10^6 bytes), names of threads, open files, ids of children."""
    tasks = list(Path("/proc/self/task").iterdir())
    children = [pid for task in tasks for pid in (task / "children").read_text().split()]
    return {
        "step": step,
        "phase": phase,
        "memory_mb": round(memory_mb(), 2),
        "threads": sorted((task / "comm").read_text().strip() for task in tasks),
        "python_threads": sorted(thread.name for thread in threading.enumerate()),
        "files": sorted(target for path in Path("/proc/self/fd").iterdir() if (target := _target(path))),
        "children": sorted(map(int, children)),
    }


def _target(path: Path) -> str | None:
    """Return what a descriptor is of; None for the one that looked."""
    try:
        return os.readlink(path)
    except OSError:
        return None


def main() -> None:
    """Run ns-train."""
    record, every = Path(sys.argv.pop(1)), int(sys.argv.pop(1))

    def note(step: int | None, phase: str) -> None:
        line = json.dumps(held(step, phase))
        with open(record, "a") as file:
            file.write(line + "\n")

    with suppress(ImportError):
        import open3d  # noqa: F401  (Closing contacts imports it; it keeps /dev/null open.)
    record.unlink(missing_ok=True)
    note(None, "before")
    iteration = BeagsTrainer.train_iteration

    def observed(self: BeagsTrainer, step: int) -> Any:
        result = iteration(self, step)
        if step % every == 0 or step == self.last_step - 1:
            note(step, "base" if step < self.schedule.base_steps else "refinement")
        return result

    BeagsTrainer.train_iteration = observed
    try:
        entrypoint()
    finally:
        gc.collect()
        note(None, "after")


if __name__ == "__main__":
    main()
