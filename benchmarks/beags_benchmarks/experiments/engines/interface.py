"""What every engine does: it runs trials, each in a process of its own, and says how they ended."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beags_benchmarks.experiments.trials import Trial


@dataclass(frozen=True)
class Needs:
    """What a trial is expected to take. cores: that it keeps busy; None: not known. memory_mb: the largest."""

    cores: int | None = None
    memory_mb: float = 1000.0  # of the loaded program alone: 900


@dataclass(frozen=True)
class Job:
    """A trial to run.

    order: its place in the experiment. folder: of the trial, absolute. base: folder of the trial that it starts from,
    which has ended.
    """

    order: int
    trial: Trial
    folder: Path
    base: Path | None = None
    needs: Needs = Needs()

    @property
    def request(self) -> dict[str, Any]:
        """Return what ``trial.json`` holds, for ``worker``: plain values, paths absolute."""
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

    killed: it failed because a signal ended it, as when memory ran out; what it had saved is still there.
    """

    folder: Path
    result: dict[str, Any] | None
    failed: str | None = None
    killed: bool = False


class Engine(ABC):
    """Runs jobs in any order. A context: leaving it ends what still runs.

    Raises ``UserError`` when it is made if it cannot run.
    """

    @classmethod
    def unavailable(cls) -> str | None:
        """Return None, or one sentence on why this engine cannot run here and what to do."""
        return None

    @abstractmethod
    def __init__(self, address: str | None) -> None:
        """Find the cluster at ``address``, if the engine has one."""

    @abstractmethod
    def __enter__(self) -> Engine: ...

    @abstractmethod
    def __exit__(self, *_: object) -> None: ...

    @abstractmethod
    def start(self, job: Job) -> None:
        """Begin a job now or later; its base has ended well, and it is not done yet."""

    @abstractmethod
    def wait(self) -> tuple[Job, Outcome]:
        """Wait until one of the jobs that were started ends; returns it, with a folder that holds all its files.

        A job that fails has a reason; nothing is raised.
        """
