"""Count lines of code, words of pages and options: ``python scripts/counts.py [--options]``."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def lines(folder: str, *suffixes: str) -> int:
    """Return the number of lines of the files with these suffixes in ``folder``, tests aside; 0 without the folder."""
    paths = [path for suffix in suffixes for path in (ROOT / folder).rglob(f"*{suffix}")]
    paths = [path for path in paths if not {"tests", "build"} & {*path.relative_to(ROOT / folder).parts}]
    return sum(len(path.read_text("utf8").splitlines()) for path in paths)


def table() -> Iterator[tuple[str, int]]:
    """Yield each quantity and its count."""
    yield "lines of Python in beags_plugin/", lines("beags_plugin", ".py")
    yield "lines of Python in baselines/", lines("baselines", ".py")
    yield "lines of Python and TOML in benchmarks/", lines("benchmarks", ".py", ".toml")
    for folder in ("tests", "baselines/tests", "benchmarks/tests"):
        yield f"lines of Python in {folder}/", lines(folder, ".py")
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    yield (
        f"words with a letter or a digit in README.md and {len(pages) - 1} pages of docs/",
        sum(any(map(str.isalnum, word)) for page in pages for word in page.read_text("utf8").split()),
    )
    yield "lines of JSON in docs/results/", lines("docs/results", ".json")


def options() -> list[str]:
    """Return the options of ``ns-train beags`` that nerfstudio does not have, as typed."""
    from beags_plugin.plugin.options.config import base_config

    config: Any = base_config()
    parser = config.pipeline.datamanager.dataparser
    names = [*_own("", config), *_own("pipeline.datamanager.", config.pipeline.datamanager)]
    names += [*_own("pipeline.model.", config.pipeline.model), *_own("beags-data ", parser)]
    return sorted(name.replace("_", "-") for name in names)


def _own(prefix: str, config: Any) -> Iterator[str]:
    theirs = {field.name for base in type(config).__mro__ if _is_theirs(base) for field in dataclasses.fields(base)}
    for field in dataclasses.fields(config):
        if field.name not in theirs and not field.name.startswith("_") and not _hidden(field):
            yield from _leaves(f"{prefix}{field.name}", getattr(config, field.name))


def _hidden(field: dataclasses.Field) -> bool:
    return "Suppress" in str(field.type)  # presets may set such a key, the command line may not


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
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--options", action="store_true", help="list the options of ns-train beags that are ours too")
    chosen = parser.parse_args()
    for what, count in table():
        print(f"{count:>8,} {what}")
    if chosen.options:
        found = options()
        print(
            f"{len(found):>8,} options of ns-train beags that are ours:", *(f"--{name}" for name in found), sep="\n  "
        )


if __name__ == "__main__":
    main()
