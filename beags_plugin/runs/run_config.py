"""Read the config.yml of a run without running code that somebody may have written into it.

nerfstudio writes its configs as YAML with Python tags, and its loader calls whatever they name. Here a tag may only
build dataclasses, enumerations and paths, and name classes, all of known packages. A finished run is read without
nerfstudio: its classes become ``Record``.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from enum import Enum
from functools import lru_cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeVar

import yaml

from beags_plugin.options.run_format import RUN_FORMAT
from beags_plugin.options.scene_options import SceneOptions
from beags_plugin.options.stages import DensifyConfig, PreparationConfig
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import reason
from beags_plugin.views.data_options import DataOptions, RunViewOptions

Config = TypeVar("Config")
_PATHS = (pathlib.PurePath, pathlib.PosixPath, pathlib.WindowsPath, pathlib.Path, pathlib.PurePosixPath)
_FUNCTIONS = {"nerfstudio.data.utils.nerfstudio_collate.nerfstudio_collate"}  # Nerfstudio's configs name no other.
MOVED = {
    "beags_plugin.core.densification.DensifyConfig": DensifyConfig,
    "beags_plugin.preparation.pipeline.PreparationConfig": PreparationConfig,
}
"""Names of these classes in the config.yml of older runs."""
BEGINNINGS = ("load_dir", "load_checkpoint", "load_config", "load_step")  # They say what a run was started from.
_GROUPS = ("nerfstudio.method_configs", "nerfstudio.dataparser_configs")


class Refused(yaml.constructor.ConstructorError):
    """A tag that no config of ours needs."""


class _Older(Exception):
    """A tag that names a class of an older version of beags."""


@lru_cache(None)
def known_packages() -> frozenset[str]:
    """Return the packages whose classes configs may name: ours, nerfstudio, and those with entry points of either."""
    every = entry_points()
    groups = [group for group in every.groups if group in _GROUPS or group.startswith("beags.")]
    values = [point.value for group in groups for point in every.select(group=group)]
    return frozenset({"beags_plugin", "nerfstudio", *(_package(value.partition(":")[0]) for value in values)})


def _package(module: str) -> str:
    return module.partition(".")[0]


class RunConfigLoader(yaml.UnsafeLoader):
    """PyYAML's loader of Python objects of known kinds; raises ``Refused`` for all others."""

    def find_python_module(self, name: str, mark: Any, unsafe: bool = False) -> Any:
        """Refuse: no config names a module."""
        raise Refused(None, None, f"it names the module {name}", mark)

    def find_python_name(self, name: str, mark: Any, unsafe: bool = False) -> Any:
        """Return the class that a tag names."""
        if name in MOVED:
            return MOVED[name]
        module, _, attribute = name.rpartition(".")
        known = _package(module) in known_packages() or f"{module}.".startswith("torch.optim.")
        if not known and name not in {f"pathlib.{kind.__name__}" for kind in _PATHS}:
            raise Refused(None, None, f"it names {name}, which no run of beags needs", mark)
        try:
            target = getattr(import_module(module), attribute)
        except (ImportError, AttributeError, UserError):
            if _package(module) == "beags_plugin":
                raise _Older from None
            raise Refused(None, None, f"it names {name}, which is not installed", mark) from None
        if not isinstance(target, type) and name not in _FUNCTIONS:
            raise Refused(None, None, f"it names {name}, which is no class", mark)
        own = _package(str(getattr(target, "__module__", "")))
        if own not in known_packages() | {"torch", "pathlib"}:  # A known module may have imported it from elsewhere.
            raise Refused(None, None, f"it names {name}, which no run of beags needs", mark)
        return target

    def make_python_instance(
        self, suffix: str, node: Any, args: Any = None, kwds: Any = None, newobj: bool = False, unsafe: bool = False
    ) -> Any:
        """Build a path or an enumeration's value, or a dataclass whose fields follow; call nothing else."""
        kind = self.find_python_name(suffix, node.start_mark)
        if isinstance(kind, type) and not kwds:
            if kind in _PATHS and all(isinstance(part, str) for part in args or ()):
                return Path(*(args or ()))
            if issubclass(kind, Enum) and len(args or ()) == 1:
                return kind(args[0])
            if newobj and dataclasses.is_dataclass(kind) and not args:
                made = kind.__new__(kind)
                for each in dataclasses.fields(kind):  # An older run may lack some.
                    if each.default_factory is not dataclasses.MISSING:
                        made.__dict__[each.name] = each.default_factory()
                return made
        raise Refused(None, None, f"it calls {suffix}, which no run of beags needs", node.start_mark)

    def set_python_instance_state(self, instance: Any, state: Any, unsafe: bool = False) -> None:
        """Set the fields of a dataclass."""
        if not (isinstance(state, dict) and all(isinstance(name, str) for name in state)):
            raise Refused(None, None, f"{type(instance).__name__} has no fields", None)
        if any(name.startswith("__") for name in state):
            raise Refused(None, None, f"{type(instance).__name__} has no such fields", None)
        instance.__dict__.update(state)


@dataclass
class Record:
    """Options of nerfstudio's own, as attributes."""


@dataclass
class RunConfig:
    """The part of a finished run's config that commands need; without nerfstudio.

    pipeline: has the options of the scene, ``model``, and of the data, ``datamanager``. source: the nodes of the whole
    YAML.
    """

    pipeline: Any = field(default_factory=Record)
    run_dir: Path | None = None
    output_dir: Path = Path("outputs")
    experiment_name: str | None = None
    method_name: str = ""
    timestamp: str = ""
    relative_model_dir: Path = Path("nerfstudio_models")
    run_format: int = 0
    source: yaml.Node | None = None

    @property
    def model_config(self) -> SceneOptions:
        """Options of the scene."""
        return self.pipeline.model

    @property
    def data_config(self) -> RunViewOptions:
        """Options of the views."""
        return self.pipeline.datamanager

    @property
    def data_path(self) -> Path:
        """The folder (or transforms .json) of the training data: --data, or the data parser's own."""
        return Path(self.data_config.data or self.data_config.dataparser.data)

    def get_base_dir(self) -> Path:
        """Return the folder of the run."""
        if self.run_dir is not None:
            return self.run_dir
        return Path(f"{self.output_dir}/{self.experiment_name or 'unnamed'}/{self.method_name}/{self.timestamp}")

    def get_checkpoint_dir(self) -> Path:
        """Return the folder of its checkpoints."""
        return self.get_base_dir() / self.relative_model_dir

    def text_in(self, folder: Path) -> str:
        """Return the text of the config.yml of a run in ``folder`` made from this one."""
        assert self.source is not None
        source = deepcopy(self.source)
        views = self.data_config
        data = {"pipeline.datamanager.data": views.data, "pipeline.datamanager.dataparser.data": views.dataparser.data}
        _set_values(source, {**dict.fromkeys(BEGINNINGS), "run_dir": folder, **data})
        return yaml.serialize(source, width=10_000)


_PLAIN: Mapping[str, type] = {
    "beags_plugin.plugin.options.config.BeagsTrainerConfig": RunConfig,
    "beags_plugin.plugin.options.config.FusedAdamConfig": Record,
    "beags_plugin.plugin.options.model_options.BeagsModelConfig": SceneOptions,
    "beags_plugin.plugin.views.datamanager.BeagsDataManagerConfig": RunViewOptions,
    "beags_plugin.plugin.views.dataparser.BeagsDataParserConfig": DataOptions,
}
"""Names of config classes that import nerfstudio, and the classes that hold the same options without it."""


class FinishedRunLoader(RunConfigLoader):
    """``RunConfigLoader`` that imports neither other packages nor modules of ours that need nerfstudio."""

    def find_python_name(self, name: str, mark: Any, unsafe: bool = False) -> Any:
        """Return the class to use for the class that a tag names."""
        if (plain := _PLAIN.get(name)) is not None:
            return plain
        package = _package(name)
        if package in known_packages() - {"beags_plugin"} or name.startswith("torch.optim."):
            return Record
        return super().find_python_name(name, mark, unsafe)

    def make_python_instance(
        self, suffix: str, node: Any, args: Any = None, kwds: Any = None, newobj: bool = False, unsafe: bool = False
    ) -> Any:
        """Build as ``RunConfigLoader`` does; ``Record`` for other packages' classes, such as enumerations."""
        kind = self.find_python_name(suffix, node.start_mark)
        return Record() if kind is Record else super().make_python_instance(suffix, node, args, kwds, newobj, unsafe)


def _only_named(loader: FinishedRunLoader, suffix: str, node: yaml.Node) -> str:
    """Return a name, such as that of a config's target, without looking it up."""
    if _package(suffix) not in known_packages() and not suffix.startswith("torch.optim."):
        loader.find_python_name(suffix, node.start_mark)  # This raises Refused.
    return suffix


FinishedRunLoader.add_multi_constructor("tag:yaml.org,2002:python/name:", _only_named)


def other_format(run: object, version: object = None) -> UserError:
    """Return the error for a run of another version than ours. run: its config.yml. version: the one in it, if any."""
    age = "a newer" if isinstance(version, int) and version > RUN_FORMAT else "an older"
    return UserError(f"{run} was written by {age} version of beags: train again, or use the version that wrote it.")


def read_run_config(path: Path) -> RunConfig:
    """Read the config of a finished run without nerfstudio; raises ``UserError`` as ``loaded`` does."""

    def both(text: str) -> RunConfig:
        loader = FinishedRunLoader(text)
        try:
            node = loader.get_single_node()
            config = loader.construct_document(node)
        finally:
            loader.dispose()
        if isinstance(config, RunConfig):
            config.source = node
        return config

    return loaded(path, both, RunConfig)


def loaded(path: Path, load: Callable[[str], Any], kind: type[Config]) -> Config:
    """Return the config that ``load`` makes of a file's text.

    Raises ``UserError`` for any other file, or an older run's.
    """
    try:
        config = load(path.read_text("utf8"))
    except OSError as error:
        raise UserError(f"{path} cannot be read ({reason(error)}): name the config.yml of a run.") from error
    except Refused as error:
        raise UserError(f"{path} is refused, since {error.problem}: name a config.yml that ns-train wrote.") from error
    except _Older:
        raise other_format(path) from None
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        raise UserError(f"{path} is no YAML of a run ({_reason(error)}): restore it, or name another run.") from error
    if not isinstance(config, kind):
        raise UserError(f"{path} is not a run of ns-train beags: name the config.yml of one.")
    if (version := vars(config).get("run_format")) != RUN_FORMAT:
        raise other_format(path, version)
    return config


def _set_values(node: yaml.Node, values: Mapping[str, Path | int | None]) -> None:
    """Set entries of a config's nodes in place, by dotted names."""
    for name, value in values.items():
        *parents, last = name.split(".")
        holder = node
        for each in parents:
            holder = next(child for key, child in holder.value if key.value == each)
        new = yaml.compose(yaml.dump(str(value) if isinstance(value, Path) else value))
        if isinstance(value, Path):
            tag = f"tag:yaml.org,2002:python/object/apply:pathlib.{type(value).__name__}"
            new = yaml.SequenceNode(tag, [new], flow_style=True)
        holder.value = [(key, new if key.value == last else child) for key, child in holder.value]


def _reason(error: Exception) -> str:
    if isinstance(error, yaml.MarkedYAMLError):
        line = "" if error.problem_mark is None else f", line {error.problem_mark.line + 1}"
        return f"{error.problem or 'broken'}{line}"
    return "it is nested too deeply" if isinstance(error, RecursionError) else reason(error)
