"""The interface of engines, which run trials in processes of their own and return the outcomes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beags_benchmarks.experiments.trials import Trial


@dataclass(frozen=True)
class Needs:
    """Expected needs of a trial. cores: cores that it keeps busy; None if unknown. memory_mb: peak memory."""

    cores: int | None = None
    memory_mb: float = 1000.0  # the loaded program takes 900


@dataclass(frozen=True)
class Job:
    """A trial to run.

    order: its place in the experiment. folder: folder of the trial, absolute. base: folder of the finished trial that
    it starts from.
    """

    order: int
    trial: Trial
    folder: Path
    base: Path | None = None
    needs: Needs = Needs()

    @property
    def request(self) -> dict[str, Any]:
        """Return the content of ``trial.json`` for ``worker``: plain values, paths absolute."""
        trial = self.trial
        return {
            "preset": trial.preset,
            "data": str(trial.scene.data.absolute()),
            "downscale": trial.scene.downscale,
            "options": dict(trial.scene.options),
            "masks": None if trial.masks is None else str(trial.masks.absolute()),
            "base": None if self.base is None else str(self.base / "run"),
            "seed": trial.seed,
            "overrides": dict(trial.overrides),
            "digest": trial.digest,
        }


@dataclass(frozen=True)
class Outcome:
    """The outcome of a trial: the content of result.json, or the reason of its failure in a sentence.

    killed: whether a signal ended it, for example when memory ran out; its saved state is still there.
    """

    folder: Path
    result: dict[str, Any] | None
    failed: str | None = None
    killed: bool = False


class Engine(ABC):
    """Runs jobs in any order. It is a context; leaving it ends running jobs.

    The constructor raises ``UserError`` if the engine cannot run.
    """

    @classmethod
    def unavailable(cls) -> str | None:
        """Return None, or one sentence on why this engine cannot run here and what to do."""
        return None

    @abstractmethod
    def __init__(self, address: str | None) -> None:
        """Set the address of the cluster, if the engine has one."""

    @abstractmethod
    def __enter__(self) -> Engine: ...

    @abstractmethod
    def __exit__(self, *_: object) -> None: ...

    @abstractmethod
    def start(self, job: Job) -> None:
        """Begin a job now or later; its base has finished well and the job is not done yet."""

    @abstractmethod
    def wait(self) -> tuple[Job, Outcome]:
        """Wait until a started job ends; returns it with its outcome, whose folder holds all its files.

        The outcome of a failed job has the reason; nothing is raised.
        """
