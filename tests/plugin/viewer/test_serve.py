"""``beags view``: a run of any origin is read as data, and only this computer is served."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
import torch
from run_folders import write_scene, write_trained

pytest.importorskip("nerfstudio")

from beags_plugin.commands import cli
from beags_plugin.plugin.options.config import config_text
from beags_plugin.plugin.options.saved_config import open_for_training
from beags_plugin.plugin.viewer import serve
from beags_plugin.system.errors import UserError


class Code:
    """Makes a file wherever it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.command = f"touch {path}"

    def __reduce__(self):
        return os.system, (self.command,)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("viewed")
    return write_trained(root / "run", write_scene(root / "lab")).parent


@pytest.fixture
def run(trained, tmp_path) -> Path:
    return shutil.copytree(trained, tmp_path / "run")


def test_a_foreign_run_is_shown_on_this_computer_alone(run, monkeypatch):
    config = open_for_training(run / "config.yml")
    config.viewer.websocket_host, config.viewer.make_share_url, config.vis = "0.0.0.0", True, "viewer_legacy"
    config.pipeline._target = torch.nn.Identity  # something else than our pipeline
    (run / "config.yml").write_text(config_text(config).replace("torch.nn.modules.linear", "torch.optim.sgd"))
    text = (run / "config.yml").read_text().replace("torch.optim.sgd.Identity", "torch.optim.sgd.SGD")
    (run / "config.yml").write_text(text)
    shown = []
    monkeypatch.setattr(serve, "_start_viewer", lambda *given: shown.append(given))
    cli.main(["view", str(run), "--port", "7123"])
    ((config, pipeline, step),) = shown
    assert (config.vis, config.viewer.websocket_host, config.viewer.websocket_port) == ("viewer", "127.0.0.1", 7123)
    assert not config.viewer.make_share_url and step == 199
    assert pipeline.model.num_points == 75 and not pipeline.training


def test_nothing_of_a_foreign_run_is_executed(run, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(serve, "_start_viewer", lambda *_: pytest.fail("it is shown"))
    ran = tmp_path / "ran"
    text = (run / "config.yml").read_text()
    (run / "config.yml").write_text(f"{text}\nhidden: !!python/object/apply:os.system ['touch {ran}']\n")
    with pytest.raises(SystemExit) as end:
        cli.main(["view", str(run)])
    assert end.value.code == 2 and "is refused, since it names" in " ".join(capsys.readouterr().out.split())
    (run / "config.yml").write_text(text)
    checkpoint = next((run / "nerfstudio_models").glob("*.ckpt"))
    content = torch.load(checkpoint, weights_only=True)
    torch.save({**content, "hidden": Code(ran)}, checkpoint)
    with pytest.raises(UserError, match="is damaged"):
        serve.viewed_pipeline(run / "config.yml")
    assert not ran.exists()
