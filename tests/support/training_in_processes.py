"""A training in two processes on the CPU, started by nerfstudio's own launcher: for test_replicas.py.

nerfstudio's worker asks torch for two GPUs before it does anything. A process that it starts imports this module first,
which says yes, and only until the training begins.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import signal
from pathlib import Path

import torch

from beags_plugin.system.child_processes import end_with_parent

_TRUE = (torch.cuda.is_available, torch.cuda.device_count)
if multiprocessing.current_process().name != "MainProcess":
    torch.cuda.is_available, torch.cuda.device_count = lambda: True, lambda: 2
    end_with_parent(signal.SIGKILL)


def worker(local_rank: int, world_size: int, config, global_rank: int = 0) -> None:
    """Train as ``train_loop`` of nerfstudio, then write what this process holds."""
    torch.cuda.is_available, torch.cuda.device_count = _TRUE
    torch.set_num_threads(1)
    from nerfstudio.scripts.train import train_loop

    from beags_plugin.plugin import trainer

    out, run = Path(config.run_dir).parent, config.run_dir
    counts, views = [], []
    iteration = trainer.BeagsTrainer.train_iteration

    def noted(self, step):
        found = iteration(self, step)
        counts.append(self._model.num_points)
        views.append(int(self._model.last_render.camera.viewmat.sum() * 1e6))
        return found

    trainer.BeagsTrainer.train_iteration = noted
    ended, after = {}, trainer.BeagsTrainer._after_train

    def end(self):
        state = self.pipeline.state_dict()
        tensors = {name: value for name, value in state.items() if isinstance(value, torch.Tensor)}
        ended.update({name: hashlib.sha256(value.numpy().tobytes()).hexdigest() for name, value in tensors.items()})
        ended["adam"] = hashlib.sha256(
            b"".join(
                state["exp_avg"].numpy().tobytes()
                for optimizer in self.optimizers.optimizers.values()
                for state in optimizer.state.values()
            )
        ).hexdigest()
        own = {} if self._model.own_training is None else self._model.own_training.state()
        ended["own"] = hashlib.sha256(repr(_listed(own)).encode()).hexdigest()
        known = self._model.exposures
        ended["exposures"] = None if known is None else hashlib.sha256(known.affine.numpy().tobytes()).hexdigest()
        ended["folder"], ended["run"] = str(self.base_dir), str(self.run)
        after(self)

    trainer.BeagsTrainer._after_train = end
    train_loop(local_rank, world_size, config, global_rank)
    found = {"end": ended, "counts": counts, "views": views, "own": str(run)}
    (out / f"rank{global_rank}.json").write_text(json.dumps(found))


def _listed(value):
    """Return tensors within dicts as plain numbers, each of which repr shows in full."""
    if isinstance(value, dict):
        return {key: _listed(item) for key, item in value.items()}
    return value.tolist() if isinstance(value, torch.Tensor) else value


def train_in_two(data: Path, out: Path, **overrides) -> None:
    """Train ``out``/run on ``data``; what process i has at its end is in ``out``/rank<i>.json."""
    from nerfstudio.scripts.train import launch
    from resumed_runs import short_config

    from beags_plugin.system.lock import run_lock

    config = short_config(data, out / "run", **overrides)
    config.pipeline.datamanager.data = data  # as nerfstudio's own main
    config.set_timestamp()
    config.save_config()
    run_lock(config.get_base_dir()).release()  # for the processes, as with --machine.num-devices 2
    launch(main_func=worker, num_devices_per_machine=2, device_type="cpu", config=config)
