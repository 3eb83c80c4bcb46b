"""The two packages: this one imports what any package may, and beags knows nothing of it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1]
ROOT = FOLDER.parent
EXTENDING = ROOT / "docs/extending.md"


def public() -> set[str]:
    """Return the modules and rooms that docs/extending.md lets a package import."""
    text = EXTENDING.read_text("utf8")
    table = re.findall(r"^\| `beags\.\w+` \| `beags_plugin\.([\w.]+)\.[A-Z]\w+` \|", text, re.MULTILINE)
    (sentence,) = re.findall(r"It may import the modules of the\s+table and the examples, and ([^;]+);", text)
    named = re.findall(r"`([\w.]+)`", sentence)
    assert len(table) > 5 and len(named) > 5
    return {*table, *named}


def imported(source: str) -> Iterator[str]:
    """Yield the names of beags_plugin that a source imports, below that package."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        yield from (name.removeprefix("beags_plugin.") for name in names if name.split(".")[0] == "beags_plugin")


def refused(source: str) -> list[str]:
    """Return the imports that no public module or room has, and those of private names."""
    allowed = public()
    return [
        name
        for name in imported(source)
        if not any(name == each or name.startswith(f"{each}.") for each in allowed) or "._" in f".{name}"
    ]


def test_baselines_import_what_any_package_may():
    files = sorted((FOLDER / "beags_baselines").glob("*.py"))
    found = {path.name: refused(path.read_text("utf8")) for path in files}
    assert len(files) > 20 and not {name: names for name, names in found.items() if names}


def test_the_check_sees_what_it_should():
    assert not refused("from beags_plugin.core.surfels import Surfels\nimport torch, beags_plugin.losses.base")
    for wrong in ("plugin.model import BeagsModel", "refiners import REFINERS", "core.surfels import _private"):
        assert len(refused(f"def f():\n    from beags_plugin.{wrong}")) == 1, wrong
    assert refused("from beags_plugin import refiners")


def test_beags_names_no_module_of_baselines():
    sources = [path for path in (ROOT / "beags_plugin").rglob("*") if path.suffix in (".py", ".toml", ".html")]
    assert len(sources) > 200
    assert not [str(path) for path in sources if "beags_baselines" in path.read_text("utf8")]
