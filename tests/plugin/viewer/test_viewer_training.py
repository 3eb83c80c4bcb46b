"""A viewer beside a training: somebody watches from the first step to the last."""

from __future__ import annotations

import pytest

pytest.importorskip("nerfstudio")
pytest.importorskip("msgspec")

from resumed_runs import STEPS, assert_same_run, run_to_end, short_config
from viewer_client import ViewerClient
from viewer_pages import free_port

from beags_plugin.plugin.trainer import BeagsTrainer

OUTPUTS = ["class_map", "boundary_error", "mask_after", "depth", "rgb"]


def test_a_training_that_is_watched_ends_as_it_does_unwatched(short_run, tmp_path, monkeypatch):
    """Base, preparation and refinement, bit for bit; the render thread lives to the end and still draws."""
    config = short_config(short_run / "data", tmp_path / "watched", vis="viewer+tensorboard")
    config.viewer.websocket_port = free_port()
    client = ViewerClient(config.viewer.websocket_port, OUTPUTS, distance=1.0)
    after, iteration, last = BeagsTrainer._after_train, BeagsTrainer.train_iteration, {}

    def first_watched(self, step):
        if step in (1, STEPS[0]):  # Else so short a run would be over before a picture is drawn.
            self.train_lock.release()
            try:
                assert client.wait_for_a_picture()
            finally:
                self.train_lock.acquire()
        return iteration(self, step)

    def watched_to_the_end(self):
        last["picture"] = client.wait_for_a_picture()
        last["threads"] = list(self.viewer_state.render_statemachines.values())
        last["alive"] = [thread.is_alive() for thread in last["threads"]]
        after(self)

    monkeypatch.setattr(BeagsTrainer, "train_iteration", first_watched)
    monkeypatch.setattr(BeagsTrainer, "_after_train", watched_to_the_end)
    client.start()
    run_to_end(config)
    left = [thread.is_alive() for thread in last.pop("threads")]  # one at work would abort the end of the program
    client.close()
    assert not client.is_alive() and not client.errors
    assert last == {"picture": True, "alive": [True]} and left == [False]
    assert sum(client.pictures.values()) >= 3 and client.seen["rgb"].std() > 0
    # websockets draw from Python's own generator, the training from none but its own
    assert_same_run(tmp_path / "watched", short_run / "run", but_for="/beags/parts/random/python")
