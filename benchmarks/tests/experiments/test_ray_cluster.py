"""A Ray cluster of three nodes on this machine runs a sweep, and loses what can be lost on the way.

Slow, and skipped where Ray is missing: pip install './benchmarks[ray]'.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

pytest.importorskip("nerfstudio")
ray = pytest.importorskip("ray", reason="Ray is missing: pip install './benchmarks[ray]'")
if sys.platform != "linux":
    pytest.skip("processes are looked for in /proc, and end with those that started them", allow_module_level=True)

from experiment_files import written

from beags_benchmarks.experiments.engines import ray_cluster
from beags_benchmarks.experiments.options import ExperimentOptions
from beags_benchmarks.experiments.run import run_experiment
from beags_plugin.runs.relocation import open_run
from beags_plugin.system.errors import UserError

SWEEP = """
description = "a sweep of twelve trials: two bases, and five refinements of each"
preset = "beags-tiny"
reference = "alone"
[sample]
seeds = [5, 6]
width = 48
height = 36
num_train = 8
num_test = 2
num_points = 300
antialias = 1
[base]
"pipeline.model.base_steps" = 300
"steps_per_save" = 20
[refine]
"pipeline.model.refine_steps" = 6
[[variant]]
name = "alone"
[variant.refine]
"pipeline.model.refiner" = "none"
[[variant]]
name = "broken"
[variant.refine]
"pipeline.model.prepare.k" = 0
[[sweep]]
name = "damage"
key = "damage"
values = [0.0, 1.0, 2.0]
"""
COSTS = ("seconds", "memory")  # words in the names of figures that no two runs share
STORE = 80 << 20


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """The file of the sweep and its report by the default engine."""
    folder = tmp_path_factory.mktemp("alone")
    path = written(folder, SWEEP)
    run_experiment(path, ExperimentOptions(output=folder / "out"))
    return path, report_of(folder / "out")


@pytest.fixture
def cluster():
    """A cluster of three nodes with a core each."""
    from ray.cluster_utils import Cluster

    ends = signal.getsignal(signal.SIGTERM)  # Ray sets its own, also for the tests that follow in this process
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        node = {"num_cpus": 1, "num_gpus": 0, "object_store_memory": STORE}
        made = Cluster()
        try:
            made.add_node(**node, include_dashboard=False)
            for _ in range(2):
                made.add_node(**node)
            made.wait_for_nodes()
        except Exception as error:
            made.shutdown()
            pytest.skip(f"Ray does not start here, as on a very busy machine: {error}")
        yield made
        ray.shutdown()
        made.shutdown()
        signal.signal(signal.SIGTERM, ends)


def report_of(output: Path) -> dict:
    return json.loads((output / "mine.json").read_text())


def figures(report: dict) -> dict:
    """Return what of a report says nothing of clocks, memory, places and programs."""
    kept = {}
    for table in ("rows", "means"):
        kept[table] = [
            {name: value for name, value in row.items() if not any(word in name for word in COSTS)}
            for row in report[table]
        ]
    return kept


def until(holds: Callable[[], object], seconds: float = 540.0) -> object:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if found := holds():
            return found
        time.sleep(0.02)
    raise AssertionError("it never happened")


def training_now(output: Path) -> list[str]:
    """Return the names of trials that have saved a checkpoint and train on."""
    runs = [path.parent.parent for path in output.glob("trials/*/run/nerfstudio_models/*.ckpt")]
    return [run.parent.name for run in runs if not (run / "training.json").exists()]


def workers(name: str = "") -> list[psutil.Process]:
    """Return the workers of Ray that have a task whose name ends so."""
    found = []
    for process in psutil.process_iter():
        try:
            title = " ".join(process.cmdline())
            if title.startswith(("ray::trained", "ray::scored")) and title.rstrip().endswith(name):
                found.append(process)
        except psutil.Error:
            continue
    return found


def test_twelve_trials_on_three_nodes_give_the_figures_of_one_machine(alone, cluster, tmp_path):
    """The command is killed and begun again; then a worker is killed in its training, and a node is lost."""
    path, expected = alone
    output = tmp_path / "out"
    command = [sys.executable, "-m", "beags_plugin.commands.cli", "bench", "file", path, "--output", str(output)]
    driver = subprocess.Popen([*command, "--engine", "ray", "--address", cluster.address])
    until(lambda: training_now(output) or driver.poll() is not None)
    assert driver.poll() is None, "the first attempt has ended by itself"
    driver.kill()
    driver.wait()
    begun = {folder.name for folder in output.glob("trials/*-base-*")}
    until(lambda: not workers())

    lost: dict[str, object] = {}

    def lose() -> None:
        name = str(until(lambda: next(iter(training_now(output)), "")))
        (worker,) = until(lambda: workers(name))
        worker.send_signal(signal.SIGKILL)
        lost["worker"] = name
        until(lambda: list(output.glob("trials/*-refined-*")))
        node = cluster.list_all_nodes()[-1]
        own = psutil.Process(node.all_processes["raylet"][0].process.pid)
        until(lambda: [each for each in own.children(recursive=True) if each in workers()])
        cluster.remove_node(node, allow_graceful=False)
        lost["node"] = True

    thread = threading.Thread(target=lose, daemon=True)
    thread.start()
    ray.init(address=cluster.address, log_to_driver=False, logging_level="error")
    options = ExperimentOptions(output=output, engine="ray", address=cluster.address)
    rows = run_experiment(path, options)
    thread.join(60.0)

    assert begun and lost.keys() == {"worker", "node"}
    until(lambda: sum(node["Alive"] for node in ray.nodes()) == 2, 60.0)  # heartbeats tell, some seconds later
    report = report_of(output)
    assert len(list(output.glob("trials/*/result.json"))) == 10 and len(list(output.glob("trials/*/trial.json"))) == 12
    reasons = [row.failed for row in rows if row.variant.name == "broken"]
    assert reasons == ["k is 0: the voxel size needs at least 1 neighbour."] * 2
    assert figures(report) == figures(expected)
    resumed = json.loads((output / "trials" / str(lost["worker"]) / "result.json").read_text())
    assert resumed["cpu_seconds"] is None and resumed["steps"] == 300, "it went on from its checkpoint"


def test_nodes_that_share_nothing_are_sent_what_they_lack(alone, cluster, tmp_path, monkeypatch):
    path, expected = alone
    digest = ray_cluster.folder_digest
    monkeypatch.setattr(ray_cluster, "folder_digest", lambda folder: f"{digest(folder)[:32]}-seen-elsewhere")
    start = ray_cluster.RayEngine.start

    def start_elsewhere(self, job):
        self._mark = str(job.folder.parent / ray_cluster.MARK), "of another disk"
        start(self, job)

    monkeypatch.setattr(ray_cluster.RayEngine, "start", start_elsewhere)
    monkeypatch.setenv("BEAGS_KEPT", "1")
    options = ExperimentOptions(scenes=1, output=tmp_path / "out", engine="ray", address=cluster.address)
    rows = run_experiment(path, options)
    scene = rows[0].scene
    wanted = [row for row in figures(expected)["rows"] if row["scene"] == scene]
    assert figures(report_of(options.output))["rows"] == wanted
    for config in options.output.glob("trials/*/run/config.yml"):
        found = open_run(config)
        assert found.data_path.is_relative_to(options.output.absolute()) and found.data_path.is_dir()
        assert found.get_checkpoint_dir().is_relative_to(options.output.absolute())
    assert not list(Path(os.environ.get("TMPDIR", "/tmp")).glob("beags-*/inputs/*-seen-elsewhere"))


def test_without_an_address_this_machine_is_the_cluster(alone, tmp_path):
    path, expected = alone
    options = ExperimentOptions(scenes=1, variants=("alone",), output=tmp_path / "out", engine="ray")
    assert not ray.is_initialized()
    before = signal.getsignal(signal.SIGTERM)
    try:
        rows = run_experiment(path, options)
    except UserError as error:
        assert str(error).startswith("Ray cannot start on this machine (") and "\n" not in str(error)
        pytest.skip(str(error))
    assert not ray.is_initialized(), "it has ended with the command"
    assert signal.getsignal(signal.SIGTERM) == before, "Ray's handler has gone with it"
    wanted = [row for row in figures(expected)["rows"] if row["scene"] == rows[0].scene and row["variant"] == "alone"]
    assert figures(report_of(options.output))["rows"] == wanted


def test_a_cluster_that_is_not_there_is_one_sentence(tmp_path):
    for address in ("127.0.0.1:1", "auto"):
        options = ExperimentOptions(output=tmp_path / "out", engine="ray", address=address)
        with pytest.raises(UserError, match=f"there is no Ray cluster at {address} .*: start one with ray") as error:
            run_experiment(written(tmp_path, SWEEP), options)
        assert "\n" not in str(error.value) and not (tmp_path / "out").exists()
