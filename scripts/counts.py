"""Count what the house is made of: ``python scripts/counts.py``; options need nerfstudio, and are left out without."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def lines(folder: str) -> int:
    """Return the number of lines of Python in ``folder``."""
    return sum(len(path.read_text("utf8").splitlines()) for path in (ROOT / folder).rglob("*.py"))


def words() -> tuple[int, int]:
    """Return the numbers of documents in docs/ and of words in them."""
    documents = [path.read_text("utf8") for path in (ROOT / "docs").glob("*.md")]
    return len(documents), sum(len(text.split()) for text in documents)


def options() -> list[str]:
    """Return the options of ``ns-train beags`` that nerfstudio does not have, as they are typed."""
    from beags_plugin.plugin.options.config import base_config

    config: Any = base_config()
    parser = config.pipeline.datamanager.dataparser
    found = [*_own("", config), *_own("pipeline.datamanager.", config.pipeline.datamanager)]
    found += [*_own("pipeline.model.", config.pipeline.model), *_own("beags-data ", parser)]
    return sorted(name.replace("_", "-") for name in found)


def _own(prefix: str, config: Any) -> Iterator[str]:
    theirs = {field.name for base in type(config).__mro__ if _is_theirs(base) for field in dataclasses.fields(base)}
    for field in dataclasses.fields(config):
        if field.name not in theirs and not field.name.startswith("_") and not _hidden(field):
            yield from _leaves(f"{prefix}{field.name}", getattr(config, field.name))


def _hidden(field: dataclasses.Field) -> bool:
    return "Suppress" in str(field.type)  # a key that presets may set, and the command line does not have


def _leaves(name: str, value: Any) -> Iterator[str]:
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if not _hidden(field):
                yield from _leaves(f"{name}.{field.name}", getattr(value, field.name))
    elif isinstance(value, dict):
        for key, each in value.items():
            yield from _leaves(f"{name}.{key}", each)
    else:
        yield name


def _is_theirs(kind: type) -> bool:
    return kind.__module__.split(".")[0] == "nerfstudio" and dataclasses.is_dataclass(kind)


def main() -> None:
    loose = [path.name for path in (ROOT / "beags_plugin").glob("*.py") if path.name != "__init__.py"]
    print(f"{lines('beags_plugin'):,} lines of Python in beags_plugin/, {len(loose)} loose files at its top")
    print(f"{lines('tests'):,} lines of Python in tests/, {lines('baselines'):,} in baselines/ with its tests")
    print("{} documents with {:,} words in docs/".format(*words()))
    try:
        found = options()
    except ImportError as error:
        print(f"options are left out: {error}")
    else:
        print(f"{len(found)} options of ns-train beags are ours:")
        print("\n".join(f"  --{name}" for name in found))


if __name__ == "__main__":
    main()
