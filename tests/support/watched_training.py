"""ns-train as it is, but that either phase waits before its last step until somebody has seen it.

python watched_training.py FOLDER ARGUMENTS OF NS-TRAIN: the phase "base" or "refine" goes on once the file of that name
is in FOLDER; the viewer renders meanwhile, as between any two steps. The scene is a tenth of its size, so that it
is seen whole from where the viewer's camera is at first.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from nerfstudio.scripts.train import entrypoint

from beags_plugin.plugin.trainer import BeagsTrainer


def main() -> None:
    """Run ns-train."""
    seen = Path(sys.argv.pop(1))
    begin, iteration = BeagsTrainer.__init__, BeagsTrainer.train_iteration

    def small(self, config, *arguments, **options) -> None:
        parser = config.data_config.dataparser
        parser.center_method, parser.auto_scale_poses, parser.scale_factor = "none", False, 0.1
        begin(self, config, *arguments, **options)

    def waiting(self, step: int):
        phase = {self.schedule.base_steps - 1: "base", self.last_step - 1: "refine"}.get(step)
        if phase is not None:
            self.train_lock.release()
            try:
                while not (seen / phase).exists():
                    time.sleep(0.05)
            finally:
                self.train_lock.acquire()
        return iteration(self, step)

    BeagsTrainer.__init__, BeagsTrainer.train_iteration = small, waiting
    entrypoint()


if __name__ == "__main__":
    main()
