"""config.yml of a run, read without running code that somebody may have written into it.

nerfstudio writes its configs as YAML with Python tags, and its loader calls whatever they name. Here a tag may only
build dataclasses, enumerations and paths, and name classes, all of known packages.
"""

from __future__ import annotations

import dataclasses
import pathlib
from enum import Enum
from functools import lru_cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from beags_plugin.plugin.options.run_format import RUN_FORMAT, other_format
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import reason

if TYPE_CHECKING:
    from beags_plugin.plugin.options.config import BeagsTrainerConfig

_PATHS = (pathlib.PurePath, pathlib.PosixPath, pathlib.WindowsPath, pathlib.Path, pathlib.PurePosixPath)
_FUNCTIONS = {"nerfstudio.data.utils.nerfstudio_collate.nerfstudio_collate"}  # the only one in nerfstudio's configs
_GROUPS = ("nerfstudio.method_configs", "nerfstudio.dataparser_configs")


class Refused(yaml.constructor.ConstructorError):
    """A tag that a config does not need."""


class _Older(Exception):
    """A tag that names a class of an older version of beags."""


@lru_cache(None)
def known_packages() -> frozenset[str]:
    """Return the packages whose classes configs may name: ours, nerfstudio, and those with entry points of either."""
    groups = [group for group in entry_points().groups if group in _GROUPS or group.startswith("beags.")]
    values = [point.value for group in groups for point in entry_points(group=group)]
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
        module, _, attribute = name.rpartition(".")
        known = _package(module) in known_packages() or f"{module}.".startswith("torch.optim.")
        if not known and name not in {f"pathlib.{kind.__name__}" for kind in _PATHS}:
            raise Refused(None, None, f"it names {name}, which no run of beags needs", mark)
        try:
            found = getattr(import_module(module), attribute)
        except (ImportError, AttributeError, UserError):
            if _package(module) == "beags_plugin":
                raise _Older from None
            raise Refused(None, None, f"it names {name}, which is not installed", mark) from None
        if not isinstance(found, type) and name not in _FUNCTIONS:
            raise Refused(None, None, f"it names {name}, which is no class", mark)
        own = _package(str(getattr(found, "__module__", "")))
        if own not in known_packages() | {"torch", "pathlib"}:  # what a known module has imported from elsewhere
            raise Refused(None, None, f"it names {name}, which no run of beags needs", mark)
        return found

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
                for each in dataclasses.fields(kind):  # those that the run was made without
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


def load_run_config(path: Path) -> BeagsTrainerConfig:
    """Read the config of a run without executing code; raises ``UserError`` for any other file, or an older run's."""
    from beags_plugin.plugin.options.config import BeagsTrainerConfig

    try:
        config = yaml.load(path.read_text("utf8"), Loader=RunConfigLoader)  # noqa: S506  (it refuses what is not known)
    except OSError as error:
        raise UserError(f"{path} cannot be read ({reason(error)}): name the config.yml of a run.") from error
    except Refused as error:
        raise UserError(f"{path} is refused, since {error.problem}: name a config.yml that ns-train wrote.") from error
    except _Older:
        raise other_format(path) from None
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        raise UserError(f"{path} is no YAML of a run ({_reason(error)}): restore it, or name another run.") from error
    if not isinstance(config, BeagsTrainerConfig):
        raise UserError(f"{path} is not a run of ns-train beags: name the config.yml of one.")
    if (found := vars(config).get("run_format")) != RUN_FORMAT:
        raise other_format(path, found)
    return config


def _reason(error: Exception) -> str:
    if isinstance(error, yaml.MarkedYAMLError):
        line = "" if error.problem_mark is None else f", line {error.problem_mark.line + 1}"
        return f"{error.problem or 'broken'}{line}"
    return "it is nested too deeply" if isinstance(error, RecursionError) else reason(error)
