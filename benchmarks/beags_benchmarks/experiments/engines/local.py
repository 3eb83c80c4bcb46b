"""The default engine: this machine, one trial after the other."""

from __future__ import annotations

from bisect import insort

from beags_benchmarks.experiments.engines.interface import Engine, Job, Outcome
from beags_benchmarks.experiments.engines.trial_folder import Worker, run_in_folder
from beags_plugin.system.errors import UserError


class LocalEngine(Engine):
    """Runs jobs on this machine in the order of the experiment, each with all cores."""

    def __init__(self, address: str | None) -> None:
        if address is not None:
            raise UserError(f"--address {address} names a cluster: add --engine ray, or leave it out.")
        self._jobs: list[Job] = []
        self._worker = Worker()

    def __enter__(self) -> LocalEngine:
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.end()

    def start(self, job: Job) -> None:
        """Queue the job."""
        insort(self._jobs, job, key=lambda each: each.order)

    def wait(self) -> tuple[Job, Outcome]:
        """Run the first job of the queue."""
        job = self._jobs.pop(0)
        return job, run_in_folder(job.folder, job.request, self._worker)
