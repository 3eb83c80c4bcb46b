"""The order of trials: bases first, then their refinements, without trials that are done."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from beags_benchmarks.experiments.engines.interface import Engine, Job, Needs, Outcome
from beags_benchmarks.experiments.engines.trial_folder import finished
from beags_benchmarks.experiments.trials import Trial

Progress = Callable[[int, int], None]


def run_trials(
    trials: Sequence[Trial],
    folder: Path,
    weight: Callable[[Trial], int],
    engine: Engine,
    progress: Progress | None = None,
    needs: Callable[[Trial], Needs] = lambda _: Needs(),
) -> dict[str, Outcome]:
    """Run every trial, and its base before it, unless it is done; returns outcomes by digest.

    folder: holds a folder for each trial. weight: share of a trial in the progress, e.g. its number of steps. engine:
    an entered context. needs: forecast of a trial, called when it begins. If a trial fails, the others still run. The
    next call repeats failed trials and continues interrupted ones.
    """
    queue = {trial.digest: trial for last in trials for trial in (last.base, last) if trial is not None}
    jobs = {digest: _job(order, trial, folder.absolute()) for order, (digest, trial) in enumerate(queue.items())}
    total = sum(weight(trial) for trial in queue.values())
    outcomes: dict[str, Outcome] = {}
    ready = [job for job in jobs.values() if job.base is None]
    done = running = 0
    while ready or running:
        ended: list[tuple[Job, Outcome]] = []
        for job in ready:
            if (outcome := _without_running(job, outcomes)) is not None:
                ended.append((job, outcome))
            else:
                engine.start(replace(job, needs=needs(job.trial)))
                running += 1
        if not ended:
            ended.append(engine.wait())
            running -= 1
        for job, outcome in ended:
            outcomes[job.trial.digest] = outcome
            done += weight(job.trial)
            if progress is not None:
                progress(done, total)
        bases = {job.trial.digest for job, _ in ended}
        ready = [job for job in jobs.values() if job.trial.base is not None and job.trial.base.digest in bases]
    return {digest: outcomes[digest] for digest in jobs}


def _job(order: int, trial: Trial, folder: Path) -> Job:
    base = None if trial.base is None else folder / trial.base.folder_name
    return Job(order, trial, folder / trial.folder_name, base)


def _without_running(job: Job, outcomes: dict[str, Outcome]) -> Outcome | None:
    """Return the outcome of a job that is done or whose base failed; None for others."""
    if job.trial.base is not None and (failed := outcomes[job.trial.base.digest].failed) is not None:
        return Outcome(job.folder, None, f"its base failed: {failed}")
    result = finished(job.folder)
    return None if result is None else Outcome(job.folder, result)
