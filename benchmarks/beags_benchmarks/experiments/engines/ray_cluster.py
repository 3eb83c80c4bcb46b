"""The engine for many machines: every training and every scoring is a task of a Ray cluster."""

from __future__ import annotations

import importlib.util
import os
import secrets
import signal
import socket
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from beags_benchmarks.experiments.engines.interface import Engine, Job, Needs, Outcome
from beags_benchmarks.experiments.engines.parcels import pack, unpack
from beags_benchmarks.experiments.engines.ray_task import FOLDERS, TRAINED_FOLDER, Input, Report, Task
from beags_benchmarks.experiments.engines.trial_folder import SCORED, TRAINED
from beags_plugin.system.digests import folder_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import say
from beags_plugin.system.whole_files import write_text_atomically

MOST_ATTEMPTS = 4  # attempts at a task whose worker or node is lost
USUAL_CORES = 4  # cores for a trial of an unknown kind
STORE_BYTES = 256 << 20  # object store of a local cluster, whose one node shares the folder
LOOK_SECONDS = 30.0  # seconds between two checks of the cluster while nothing ends
MARK = ".mark"  # file in the folder of all trials whose content identifies the folder
_PASSED_ON = ("OMP_WAIT_POLICY",)  # variables for tasks, besides those that begin with BEAGS_


def share(needs: Needs, nodes: Sequence[Mapping[str, float]]) -> dict[str, float] | None:
    """Return the resources that a task requests, as options of a Ray task; None if no node can run it.

    nodes: the resources of each. If any node has a GPU, every task requests one, since CPUs give other results. A
    forecast above the largest node requests that node.
    """
    nodes = [node for node in nodes if node.get("CPU", 0) >= 1]
    gpus = [node for node in nodes if node.get("GPU", 0) >= 1]
    able = gpus or nodes
    if not able:
        return None
    each = [int(node["CPU"] // node.get("GPU", 1)) for node in able] if gpus else [int(node["CPU"]) for node in able]
    cores = max(1, min(needs.cores or min(USUAL_CORES, *each), max(each)))
    memory = min(needs.memory_mb * 1e6, max(node.get("memory", 0.0) for node in able))
    return {"num_cpus": cores, "num_gpus": int(bool(gpus)), "memory": int(memory)}


@dataclass(frozen=True)
class _Running:
    """A running task. parcel: reference to the bytes of its folder, which few tasks return."""

    job: Job
    until: str
    parcel: Any = None
    trained: Any = None
    attempt: int = 1


class RayEngine(Engine):
    """Runs jobs as tasks of a cluster at ``address``, or of one that it starts on this machine."""

    @classmethod
    def unavailable(cls) -> str | None:
        """Say how to install Ray if it is missing."""
        if importlib.util.find_spec("ray") is None:
            return "the engine ray needs Ray: pip install 'ray>=2.50'."
        return None

    def __init__(self, address: str | None) -> None:
        self._address = address
        self._ray: Any = None
        self._own = False  # whether this object opened the connection
        self._on_sigterm: Any = None  # handler of SIGTERM before Ray replaced it
        self._task: Any = None
        self._running: dict[Any, _Running] = {}
        self._parcels: dict[str, Any] = {}  # references by digest of the folder
        self._unfit: dict[str, str] = {}  # sentences by node
        self._mark: tuple[str, str] | None = None
        self._waits = False

    def __enter__(self) -> RayEngine:
        import ray  # pyright: ignore[reportMissingImports]  (an extra)

        self._ray = ray
        os.environ.setdefault("RAY_IGNORE_UNHANDLED_ERRORS", "1")  # parcels that are never fetched would be reported
        if not ray.is_initialized():
            self._on_sigterm = signal.getsignal(signal.SIGTERM)
            try:
                self._connect()
            except UserError:
                self._give_sigterm_back()
                raise
            self._own = True
        self._task = ray.remote(num_returns=2, max_retries=0)(_perform)
        return self

    def _connect(self) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        quiet = {"log_to_driver": False, "logging_level": "error"}
        if self._address is None:
            try:
                self._ray.init(address="local", include_dashboard=False, object_store_memory=STORE_BYTES, **quiet)
            except Exception as error:  # its processes must start within 15 seconds
                raise UserError(
                    f"Ray cannot start on this machine ({_first_line(error)}): try again when it is less busy, or "
                    "leave --engine out."
                ) from error
            return
        host, _, port = self._address.rpartition(":")
        try:
            if host and port.isdigit():
                socket.create_connection((host, int(port)), timeout=10.0).close()  # Ray itself would retry for minutes
            self._ray.init(address=self._address, **quiet)
        except Exception as error:  # Ray has no common class for these errors
            raise UserError(
                f"there is no Ray cluster at {self._address} ({_first_line(error)}): start one with ray start --head "
                "and run this on one of its nodes, or leave --address out to use this machine."
            ) from error

    def __exit__(self, *_: object) -> None:
        ray = self._ray
        for report in self._running:
            with suppress(Exception):
                ray.cancel(report, force=True)
        if self._parcels:
            self._forget()
        if self._own:
            ray.shutdown()
            self._give_sigterm_back()

    def _give_sigterm_back(self) -> None:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, self._on_sigterm or signal.SIG_DFL)

    def _forget(self) -> None:
        """Remove the inputs that nodes received."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy  # pyright: ignore[reportMissingImports]

        ray = self._ray
        task = ray.remote(num_cpus=0)(_forget)
        removals = [
            task.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)).remote(
                dict.fromkeys(self._parcels)
            )
            for node in self._nodes()
        ]
        ray.wait(removals, num_returns=len(removals), timeout=LOOK_SECONDS)

    def start(self, job: Job) -> None:
        """Submit the job to the cluster."""
        if self._mark is None:
            path = job.folder.parent / MARK
            if not path.exists():
                write_text_atomically(secrets.token_hex(16), path)
            self._mark = str(path), path.read_text()
        self._submit(self._from_the_start(job))

    @staticmethod
    def _from_the_start(job: Job, attempt: int = 1) -> _Running:
        is_trained = job.base is None or (job.folder / "trained.json").exists()
        return _Running(job, SCORED if is_trained else TRAINED, attempt=attempt)

    def wait(self) -> tuple[Job, Outcome]:
        """Wait for the cluster; a task that was lost or whose node is unfit is submitted again."""
        while True:
            ready, _ = self._ray.wait(list(self._running), num_returns=1, timeout=LOOK_SECONDS)
            if not ready:
                self._look()
                continue
            running = self._running.pop(ready[0])
            if (outcome := self._ended(ready[0], running)) is not None:
                return running.job, outcome

    def _submit(self, running: _Running) -> None:
        job = running.job
        assert self._mark is not None
        request = job.request
        inputs = {name: Path(request[name]) for name in FOLDERS if request[name] is not None}
        digests = {name: folder_digest(path) for name, path in inputs.items()}
        resources = share(job.needs, [node["Resources"] for node in self._nodes(fit=True)])
        resources = resources or share(job.needs, [{"CPU": 1, "memory": 0.0}])  # waits for a node
        assert resources is not None
        environment = {name: os.environ[name] for name in os.environ if name.startswith("BEAGS_") or name in _PASSED_ON}
        task = Task(
            str(job.folder),
            self._mark,
            request,
            running.until,
            job.trial.code,
            {**environment, "OMP_NUM_THREADS": str(int(resources["num_cpus"]))},
            {name: Input(str(path), digests[name], self._parcels.get(digests[name])) for name, path in inputs.items()},
            running.trained,
        )
        options = {"name": f"{running.until} {job.folder.name}", **resources}
        if self._unfit:
            options["label_selector"] = {"ray.io/node-id": f"!in({','.join(self._unfit)})"}
        report, parcel = self._task.options(**options).remote(task)
        self._running[report] = replace(running, parcel=parcel)

    def _ended(self, reference: Any, running: _Running) -> Outcome | None:
        """Return the outcome of a job after one of its tasks ended; None if the job continues."""
        ray, job = self._ray, running.job
        try:
            report: Report = ray.get(reference)
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, ray.exceptions.RayError):  # the node with its inputs is gone
                return self._again(self._from_the_start(job, running.attempt), "what it needs was lost")
            return Outcome(job.folder, None, f"its task failed: {_first_line(error.cause or error)}")
        except ray.exceptions.RayError as error:
            return self._again(running, f"its worker was lost ({type(error).__name__})")
        if report.unfit is not None:
            return self._elsewhere(running, report.node, report.unfit)
        if report.lacks:
            return self._sent(running, report.lacks)
        outcome = report.outcome
        assert outcome is not None
        if outcome.killed:
            return self._again(running, f"on {report.host} {outcome.failed}")
        if running.until == TRAINED and outcome.failed is None:
            self._submit(replace(running, until=SCORED, trained=None if report.shared else running.parcel, attempt=1))
            return None
        try:
            if not report.shared and (parcel := ray.get(running.parcel)) is not None:
                unpack(parcel, job.folder)
            return replace(outcome, folder=job.folder)
        except ray.exceptions.RayError as error:
            return self._again(running, f"its result was lost ({type(error).__name__})")
        except UserError as error:  # this machine's disk may be full
            return Outcome(job.folder, None, str(error))

    def _sent(self, running: _Running, lacks: Sequence[str]) -> None:
        """Pack the inputs that a node lacks and submit the task again."""
        for name in lacks:
            if name == TRAINED_FOLDER:
                running = replace(running, trained=self._ray.put(pack(running.job.folder)))
                continue
            folder = Path(running.job.request[name])
            if (digest := folder_digest(folder)) not in self._parcels:
                self._parcels[digest] = self._ray.put(pack(folder))
        self._submit(running)

    def _again(self, running: _Running, reason: str) -> Outcome | None:
        if running.attempt >= MOST_ATTEMPTS:
            return Outcome(running.job.folder, None, f"{reason}, the last of {MOST_ATTEMPTS} attempts")
        say(f"{running.job.folder.name}: {reason.rstrip('.')}; it is started again.")
        self._submit(replace(running, attempt=running.attempt + 1))
        return None

    def _elsewhere(self, running: _Running, node: str, reason: str) -> Outcome | None:
        """Submit the task for another node; the job fails if all are unfit."""
        if node not in self._unfit:
            say(f"A node is left out: {reason}")
            self._unfit[node] = reason
        if not self._nodes(fit=True):
            return Outcome(running.job.folder, None, f"no node of the cluster can run it; of the last one: {reason}")
        self._submit(running)
        return None

    def _nodes(self, fit: bool = False) -> list[dict[str, Any]]:
        """Return the live nodes; fit: only those that can run our tasks."""
        alive = [node for node in self._ray.nodes() if node["Alive"]]
        return [node for node in alive if node["NodeID"] not in self._unfit] if fit else alive

    def _look(self) -> None:
        """Print once that no node can run the waiting tasks, for example after the last one with a GPU was lost."""
        stuck = share(Needs(), [node["Resources"] for node in self._nodes(fit=True)]) is None
        if stuck and not self._waits:
            say("The cluster has no node that can run a trial: waiting for one to join.")
        self._waits = stuck


def _perform(task: Task) -> tuple[Report, bytes | None]:
    import ray  # pyright: ignore[reportMissingImports]

    from beags_benchmarks.experiments.engines.ray_task import perform

    return perform(task, ray.get_runtime_context().get_node_id(), ray.get)


def _forget(digests: Mapping[str, Any]) -> None:
    import ray  # pyright: ignore[reportMissingImports]

    from beags_benchmarks.experiments.engines.ray_task import forget

    forget(ray.get_runtime_context().get_node_id(), digests)


def _first_line(error: BaseException) -> str:
    return f"{error}".strip().splitlines()[0] if f"{error}".strip() else type(error).__name__
