"""config.yml of a run, read without running what a stranger may have written into it.

nerfstudio writes its configs as YAML with Python tags, and reads them with a loader that calls whatever they name. Here
a tag may build only what a config is made of: dataclasses and paths, and name only classes, all of known packages.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Iterator
from enum import Enum
from functools import lru_cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import reason

if TYPE_CHECKING:
    from beags_plugin.plugin.options.config import BeagsTrainerConfig

MOST_BYTES = 1 << 20
MOST_DIGITS = 100
_PATHS = (pathlib.PurePath, pathlib.PosixPath, pathlib.WindowsPath, pathlib.Path, pathlib.PurePosixPath)
_FUNCTIONS = {"nerfstudio.data.utils.nerfstudio_collate.nerfstudio_collate"}  # the only one in nerfstudio's configs
_GROUPS = ("nerfstudio.method_configs", "nerfstudio.dataparser_configs")


class Refused(yaml.constructor.ConstructorError):
    """A tag that a config has no need of."""


@lru_cache(None)
def known_packages() -> frozenset[str]:
    """Packages whose classes configs may name: ours, nerfstudio, and those that entry points register with either."""
    groups = [group for group in entry_points().groups if group in _GROUPS or group.startswith("beags.")]
    values = [point.value for group in groups for point in entry_points(group=group)]
    return frozenset({"beags_plugin", "nerfstudio", *(_package(value.partition(":")[0]) for value in values)})


def _package(module: str) -> str:
    return module.partition(".")[0]


class RunConfigLoader(yaml.UnsafeLoader):
    """PyYAML's loader of Python objects, which may be of known kinds only; ``Refused`` for all others."""

    def find_python_module(self, name: str, mark: Any, unsafe: bool = False) -> Any:
        """No config names a module."""
        raise Refused(None, None, f"it names the module {name}", mark)

    def find_python_name(self, name: str, mark: Any, unsafe: bool = False) -> Any:
        """The class that a tag names."""
        module, _, attribute = name.rpartition(".")
        known = (
            module.partition(".")[0] in known_packages() or module == "torch.optim" or module.startswith("torch.optim.")
        )
        if not known and name not in {f"pathlib.{kind.__name__}" for kind in _PATHS}:
            raise Refused(None, None, f"it names {name}, which no run of beags needs", mark)
        try:
            found = getattr(import_module(module), attribute)
        except (ImportError, AttributeError):
            raise Refused(None, None, f"it names {name}, which this version does not have", mark) from None
        if not isinstance(found, type) and name not in _FUNCTIONS:
            raise Refused(None, None, f"it names {name}, which is no class", mark)
        own = _package(str(getattr(found, "__module__", "")))
        if own not in known_packages() | {"torch", "pathlib"}:  # what a known module has imported from elsewhere
            raise Refused(None, None, f"it names {name}, which no run of beags needs", mark)
        return found

    def make_python_instance(
        self, suffix: str, node: Any, args: Any = None, kwds: Any = None, newobj: bool = False, unsafe: bool = False
    ) -> Any:
        """A path from its parts, or a dataclass whose fields follow; nothing else is called."""
        kind = self.find_python_name(suffix, node.start_mark)
        if not isinstance(kind, type):
            raise Refused(None, None, f"it calls {suffix}, which no run of beags needs", node.start_mark)
        if kind in _PATHS and not kwds and all(isinstance(part, str) for part in args or ()):
            return Path(*(args or ()))
        if issubclass(kind, Enum) and len(args or ()) == 1 and not kwds:
            return kind(args[0])
        if newobj and dataclasses.is_dataclass(kind) and isinstance(kind, type) and not args and not kwds:
            return kind.__new__(kind)
        raise Refused(None, None, f"it calls {suffix}, which no run of beags needs", node.start_mark)

    def set_python_instance_state(self, instance: Any, state: Any, unsafe: bool = False) -> None:
        """Set the fields of a dataclass."""
        if not (isinstance(state, dict) and all(isinstance(name, str) and name.isidentifier() for name in state)):
            raise Refused(None, None, f"{type(instance).__name__} has no fields", None)
        if any(name.startswith("__") for name in state):
            raise Refused(None, None, f"{type(instance).__name__} has no such fields", None)
        instance.__dict__.update(state)

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        """A table, whose keys may only be text: lists of lists as keys take forever to hash."""
        if any(not isinstance(key, yaml.ScalarNode) for key, _ in getattr(node, "value", ())):
            raise Refused(None, None, "a key in it is no text", node.start_mark)
        return super().construct_mapping(node, deep)

    def construct_scalar(self, node: Any) -> Any:
        """A value; a number is short."""
        number = node.tag in ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
        if number and len(str(node.value)) > MOST_DIGITS:
            raise Refused(None, None, f"a number in it has more than {MOST_DIGITS} digits", node.start_mark)
        return super().construct_scalar(node)

    def flatten_mapping(self, node: Any) -> None:
        """Merged tables, which configs do not have, may grow without end."""
        if any(key.tag == "tag:yaml.org,2002:merge" for key, _ in node.value):
            raise Refused(None, None, "it merges tables", node.start_mark)
        super().flatten_mapping(node)


def load_run_config(path: Path) -> BeagsTrainerConfig:
    """The config of a run of ours, of which nothing was run; raises ``UserError`` if the file is none, or would run."""
    from beags_plugin.plugin.options.config import BeagsTrainerConfig

    try:
        if path.stat().st_size > MOST_BYTES:
            raise UserError(f"{path} is longer than any config of a run: name the config.yml of a run.")
        config = yaml.load(path.read_text("utf8"), Loader=RunConfigLoader)  # noqa: S506  (it refuses what is not known)
    except OSError as error:
        raise UserError(f"{path} cannot be read ({reason(error)}): name the config.yml of a run.") from error
    except Refused as error:
        raise UserError(f"{path} is refused, since {error.problem}: name a config.yml that ns-train wrote.") from error
    except UserError:
        raise
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        raise UserError(f"{path} is no YAML of a run ({_told(error)}): restore it, or name another run.") from error
    if not isinstance(config, BeagsTrainerConfig):
        raise UserError(f"{path} is not a run of ns-train beags: name the config.yml of one.")
    for wrong in _wrong(config):
        raise UserError(f"{path} {wrong}: another version of beags has written it; train again, or use that version.")
    return config


def _told(error: Exception) -> str:
    if isinstance(error, yaml.MarkedYAMLError):
        line = "" if error.problem_mark is None else f", line {error.problem_mark.line + 1}"
        return f"{error.problem or 'broken'}{line}"
    return "it is nested too deeply" if isinstance(error, RecursionError) else reason(error)


def _wrong(config: BeagsTrainerConfig) -> Iterator[str]:
    """What fields of a config, and of those in it, are missing, or are no numbers where they should be."""
    from beags_plugin.plugin.options.model_options import BeagsModelConfig
    from beags_plugin.plugin.views.datamanager import BeagsDataManagerConfig
    from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig

    kinds = {"model": BeagsModelConfig, "datamanager": BeagsDataManagerConfig}
    for name, kind in kinds.items():
        if not isinstance(getattr(getattr(config, "pipeline", None), name, None), kind):
            yield f"has no {name} of beags"
    if not isinstance(getattr(config.data_config, "dataparser", None), BeagsDataParserConfig):
        yield "has no data parser of beags"
    logging = getattr(config, "logging", None)
    for name, folder in (
        ("model", getattr(config, "relative_model_dir", "")),
        ("log", getattr(logging, "relative_log_dir", "")),
    ):
        if Path(folder).is_absolute() or ".." in Path(folder).parts:
            yield f"keeps its {name} folder elsewhere ({folder})"
    waiting: list[Any] = [config]
    seen = set()
    while waiting:
        value = waiting.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            for field in dataclasses.fields(value):
                held = getattr(value, field.name, dataclasses.MISSING)
                if held is dataclasses.MISSING:
                    yield f"lacks {field.name} of {type(value).__name__}"
                elif field.name == "_target" and not _is_own(held, field):
                    yield f"lets {type(value).__name__} make a {getattr(held, '__name__', held)}"
                elif isinstance(field.default, (int, float)) and not isinstance(held, (int, float, type(None))):
                    yield f"gives {field.name} of {type(value).__name__} no number"
                waiting.append(held)
        elif isinstance(value, dict):
            waiting += value.values()
        elif isinstance(value, (list, tuple)):
            waiting += value


def _is_own(target: Any, field: dataclasses.Field) -> bool:
    """Whether a config makes what its class is for, or a kind of it."""
    usual = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
    return target == usual or (isinstance(target, type) and isinstance(usual, type) and issubclass(target, usual))
