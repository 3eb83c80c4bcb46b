"""The table of mistakes: changes to a good scene or run, and the command that then prints a sentence."""

from __future__ import annotations

import builtins
import errno
import io
import json
import os
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from resumed_runs import Killed, run_to_end
from run_folders import write_scene, write_trained

Command = Callable[[], None]
TRAINED = "trained"  # the folder of the run that ``Place.train`` begins
SHORT = (
    *("--pipeline.model.base-steps", "4", "--pipeline.model.refine-steps", "2", "--pipeline.model.prepare.k", "5"),
    *("--pipeline.model.prepare.reprojection", "voxel"),
)
"""Flags of ns-train for a run that comes through all its phases in a second."""


TABLE: dict[str, Callable[[Place], Command]] = {}
"""Name to what makes the mistake in a ``Place`` and returns the command that meets it."""


def mistakes(area: str, makers: dict[str, Callable[[Place], Command]]) -> None:
    """Add mistakes to the table."""
    for name, make in makers.items():
        title = f"{area}: {name}"
        assert title not in TABLE
        TABLE[title] = make


def mistake(area: str, name: str) -> Callable[[Callable[[Place], Command]], None]:
    """Add the decorated function to the table."""
    return lambda make: mistakes(area, {name: make})


def train_after(change: Callable[[Place], Any], *flags: str, **settings: Any) -> Callable[[Place], Command]:
    """Return a mistake that ``change`` makes and ns-train meets."""

    def make(at: Place) -> Command:
        change(at)
        return at.train(*flags, **settings)

    return make


def beags_after(change: Callable[[Place], Any], words: str) -> Callable[[Place], Command]:
    """Return a mistake that ``change`` makes and ``beags`` with these words meets."""

    def make(at: Place) -> Command:
        change(at)
        return at.beags(words)

    return make


class Templates:
    """A good scene and a run that was interrupted, made once and copied for every mistake."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.scene = write_scene(root / "scene")

    def broken_off(self, config: Any) -> Path:
        """Return a run on the scene that was killed in the middle of refinement, with a checkpoint to resume from."""
        from beags_plugin.plugin.trainer import BeagsTrainer

        train = BeagsTrainer.train_iteration

        def iteration(trainer, step):
            if step == 9:
                trainer.save_checkpoint(8)
                raise Killed
            return train(trainer, step)

        folder = self.root / "broken_off"
        if not folder.exists():
            config.data, config.run_dir = self.scene, folder
            with pytest.MonkeyPatch.context() as patch, suppress(Killed):
                patch.setattr(BeagsTrainer, "train_iteration", iteration)
                run_to_end(config)
        return folder


class Place:
    """The folder of one mistake: ``data``, a good scene, and ``run``, a refined run of it, appear when asked for."""

    def __init__(self, root: Path, templates: Templates, patch: pytest.MonkeyPatch) -> None:
        self.root, self.patch, self.templates = root, patch, templates

    @property
    def data(self) -> Path:
        """Return a scene of nine photos with masks, transforms.json and classes.json."""
        folder = self.root / "data"
        if not folder.exists():
            shutil.copytree(self.templates.scene, folder)
        return folder

    @property
    def run(self) -> Path:
        """Return a refined run on ``data``."""
        folder = self.root / "run"
        if not folder.exists():
            write_trained(folder, self.data)
        return folder

    @property
    def photo(self) -> Path:
        """Return one of the photos."""
        return self.data / "images/v02.png"

    @property
    def checkpoint(self) -> Path:
        """Return the checkpoint of the run."""
        return next((self.run / "nerfstudio_models").iterdir())

    def beags(self, *words: object) -> Command:
        """Return the command ``beags``; {run} stands for the config of the run, {data} for the data."""
        from beags_plugin.commands import cli

        texts = [str(word) for text in words for word in ([text] if isinstance(text, Path) else str(text).split())]
        known = {"{run}": lambda: str(self.run / "config.yml"), "{data}": lambda: str(self.data)}
        texts = [known[text]() if text in known else text for text in texts]
        return lambda: cli.main(texts)

    def train(self, *flags: str, preset: str = "beags-tiny", data: Path | None = None, **settings: Any) -> Command:
        """Return the command ``ns-train`` on ``data``, as nerfstudio's entry point runs it."""
        config = self.config(*flags, preset=preset, data=data)
        for name, value in settings.items():
            setattr(config, name, value)
        return lambda: ns_train(config)

    def config(self, *flags: str, preset: str = "beags-tiny", data: Path | None = None) -> Any:
        """Return the config that ns-train makes of its flags, to train in ``trained``."""
        config = deepcopy(_parsed(preset, flags))
        config.data = self.data if data is None else data
        config.run_dir = self.root / TRAINED
        config.vis = "tensorboard"
        config.logging.local_writer.enable = False
        return config

    def edit_poses(self, change: Callable[[Any], Any]) -> None:
        """Change transforms.json, in place."""
        path = self.data / "transforms.json"
        content = json.loads(path.read_text("utf8"))
        change(content)
        path.write_text(json.dumps(content), "utf8")

    def cut(self, path: Path, share: float = 0.5) -> Path:
        """Keep the first part of a file only."""
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])
        return path

    def fail_to_write(self, folder: Path, code: int = errno.ENOSPC, after: int = 0) -> None:
        """Let the system refuse what is written below ``folder``: no space, no permission, a disk that is read-only.

        after: bytes of each file that it still takes.
        """
        opened = io.open

        def refusing(file, mode="r", *rest, **options):
            inside = isinstance(file, (str, os.PathLike)) and Path(file).absolute().is_relative_to(folder)
            if not inside or not set(mode) & set("wax+"):
                return opened(file, mode, *rest, **options)
            if code != errno.ENOSPC:
                raise OSError(code, os.strerror(code), str(file))
            return _Full(opened(file, mode, *rest, **options), after)

        self.patch.setattr(builtins, "open", refusing)
        self.patch.setattr(io, "open", refusing)
        if code != errno.ENOSPC:
            made = os.mkdir

            def refusing_folder(path, *rest, **options):
                inside = Path(path).absolute().is_relative_to(folder)
                if inside and Path(path).parent.exists():  # else the system says that it is absent
                    raise OSError(code, os.strerror(code), str(path))
                made(path, *rest, **options)

            self.patch.setattr(os, "mkdir", refusing_folder)


class _Full:
    """A file on a disk that is full after some bytes."""

    def __init__(self, stream: Any, left: int) -> None:
        self._stream, self._left = stream, left

    def write(self, content: Any) -> int:
        self._left -= len(content) if isinstance(content, str) else memoryview(content).nbytes
        if self._left < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._stream.write(content)

    def __enter__(self) -> _Full:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@lru_cache(None)
def _parsed(preset: str, flags: Sequence[str]) -> Any:
    """Return the config that ns-train makes of its flags; its own parser takes half a second a time."""
    from beags_plugin.plugin.presets import load_preset

    config = load_preset(preset).config
    config.pipeline.datamanager.dataparser.num_random_points = 200
    whole, words = config, list(flags)
    while words:
        word = words.pop(0)
        if word == "beags-data":
            config = whole.pipeline.datamanager.dataparser
            continue
        *parents, last = word.removeprefix("--").replace("-", "_").split(".")
        values = []
        while words and not words[0].startswith("--") and words[0] != "beags-data":
            values.append(words.pop(0))
        _set(config, parents, last, values)
    return whole


def _set(holder: Any, parents: list[str], name: str, values: list[str]) -> None:
    """Set an option, also of a frozen part, as a value of the kind that it has."""
    if len(parents) > 1:
        return _set(getattr(holder, parents[0]), parents[1:], name, values)
    part = getattr(holder, parents[0]) if parents else holder
    value = _converted(getattr(part, name), name, values)
    if type(part).__dataclass_params__.frozen:
        setattr(holder, parents[0], replace(part, **{name: value}))
    else:
        setattr(part, name, value)


def _converted(current: Any, name: str, values: list[str]) -> Any:
    if isinstance(current, tuple):
        kind = type(current[0]) if current else {"ignore_ids": int}.get(name, str)
        return tuple(kind(value) for value in values)
    if isinstance(current, dict):  # numbers as numbers
        return dict(zip(values[::2], map(yaml.safe_load, values[1::2]), strict=True))
    if current is None or isinstance(current, Path):
        return {"downscale_factor": float}.get(name, Path)(values[0])
    return type(current)(values[0])


def ns_train(config: Any) -> None:
    """Train with a config, as nerfstudio's entry point does."""
    from nerfstudio.scripts.train import main

    main(config)
