"""Imports go one way: each room of the package imports only rooms to its right, and no two files one another."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "beags_plugin"

# Rooms in order, from what people call to what knows nothing of scenes. Rooms on one line do not import one another.
ROOMS = [
    "commands",
    "plugin",  # its own files; the rooms inside it follow
    "plugin/viewer",
    "plugin/training",
    "plugin/options",
    "plugin/views",
    "objects",
    "pictures",
    "runs",
    "views",
    "evaluation",
    "refiners",
    "preparation",
    "losses",
    "export",
    "masks",
    "occupancy assignment surfaces importers cleaning picking",
    "rasterizers splat_io",
    "core",
    "ops",
    "posing",
    "data",
    "labels sample",
    "system options",
]
ORDER = {room: place for place, rooms in enumerate(ROOMS) for room in rooms.split()}
MODULES = {path.relative_to(PACKAGE).with_suffix("").as_posix(): path for path in PACKAGE.rglob("*.py")}
CONFIGS = "plugin/options/"  # its configs, which are nerfstudio's, name what they set up, above them
TARGETS = {"plugin/model", "plugin/pipeline", "plugin/trainer"}
NERFSTUDIO = {"commands"}  # All rooms of plugin/ know it too.


def room_of(module: str) -> str:
    """The room of a module such as ``plugin/runs/read``; raises ``LookupError`` where there is none."""
    parts = module.split("/")[:-1]
    for depth in (2, 1):
        if (room := "/".join(parts[:depth])) in ORDER:
            return room
    raise LookupError(f"beags_plugin/{module}.py lies in no room of the list")


@cache
def nodes(source: str) -> list[ast.AST]:
    return list(ast.walk(ast.parse(source)))


def imported(source: str) -> Iterator[str]:
    """Dotted names that a source imports, at its top, inside functions and under TYPE_CHECKING."""
    for node in nodes(source):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports name the whole module"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def named_in_strings(source: str) -> Iterator[str]:
    """Modules that a source names as a registry or ``system.registry.load`` takes them: "module:Class"."""
    for node in nodes(source):
        text = node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""
        if match := re.fullmatch(r"(beags_plugin(?:\.\w+)+):\w+", text):
            yield match[1]


def module_of(name: str) -> str | None:
    """The module of this package in which an imported name lies; None for other packages."""
    parts = name.split(".")
    if parts[0] != "beags_plugin":
        return None
    for length in range(len(parts), 1, -1):
        path = "/".join(parts[1:length])
        if path in MODULES:
            return path
        if f"{path}/__init__" in MODULES:
            return f"{path}/__init__"
    return None


def arrows() -> dict[str, set[str]]:
    """Every module and the modules of this package that it imports."""
    found = {module: set(map(module_of, imported(path.read_text()))) for module, path in MODULES.items()}
    return {module: {each for each in targets - {module} if each is not None} for module, targets in found.items()}


def lazy_arrows() -> dict[str, set[str]]:
    """Every module and the modules of this package that its strings name, but for what nerfstudio's configs set up."""
    return {module: lazy_targets(module, path.read_text()) for module, path in MODULES.items()}


def lazy_targets(module: str, source: str) -> set[str]:
    """The modules of this package that the strings of one module name, but for those that its configs set up."""
    named = {each for each in map(module_of, named_in_strings(source)) if each is not None}
    return named - TARGETS if module.startswith(CONFIGS) else named


def upward(links: dict[str, set[str]]) -> list[str]:
    """A sentence for every import of a room that is not to the right."""
    return [
        f"beags_plugin/{one}.py imports beags_plugin/{other}.py, but {room_of(other)} does not lie to the right of "
        f"{room_of(one)}"
        for one, targets in sorted(links.items())
        for other in sorted(targets)
        if one != "__init__" and room_of(one) != room_of(other) and ORDER[room_of(one)] >= ORDER[room_of(other)]
    ]


def circles(links: dict[str, set[str]]) -> list[list[str]]:
    """Files that import one another, each circle as the path through it."""
    done: set[str] = set()
    found = []

    def walk(module: str, path: list[str]) -> None:
        if module in path:
            found.append([*path[path.index(module) :], module])
        elif module not in done:
            for each in sorted(links[module]):
                walk(each, [*path, module])
            done.add(module)

    for module in sorted(links):
        walk(module, [])
    return found


def test_imports_go_to_the_right():
    assert not (found := upward(arrows())), "\n".join(found)
    assert not (found := upward(lazy_arrows())), "\n".join(found)


def test_no_files_import_one_another():
    assert not (found := circles(arrows())), "\n".join(" -> ".join(circle) for circle in found)


def test_the_check_sees_what_it_should():
    links = {"core/sh": {"plugin/model"}, "losses/base": {"preparation/pipeline"}, "plugin/model": {"core/sh"}}
    assert [sentence.split(",")[0] for sentence in upward(links)] == [
        "beags_plugin/core/sh.py imports beags_plugin/plugin/model.py",
        "beags_plugin/losses/base.py imports beags_plugin/preparation/pipeline.py",
    ]
    assert circles({**links, "preparation/pipeline": set()}) == [["core/sh", "plugin/model", "core/sh"]]
    hidden = "def f():\n    from beags_plugin.core import sh\n"
    hidden += "if TYPE_CHECKING:\n    from beags_plugin.losses import LOSSES\n"
    assert {module_of(name) for name in imported(hidden)} == {"core/sh", "losses/__init__"}
    strings = 'load("beags_plugin.core.sh:rotated")\n"""See beags_plugin.core.cameras: Camera."""\n'
    assert [module_of(name) for name in named_in_strings(strings)] == ["core/sh"]
    target = 'load("beags_plugin.plugin.model:BeagsModel")'
    assert lazy_targets("plugin/options/config", target) == set()
    assert upward({"core/sh": lazy_targets("core/sh", target)}), "only configs of nerfstudio may name what they set up"


def behaviour(source: str) -> set[str]:
    """The functions, methods but properties, and statements other than constants and classes in a source."""
    top = ast.parse(source).body
    statements = [*top, *(inner for node in top if isinstance(node, ast.ClassDef) for inner in node.body)]
    data = (ast.Import, ast.ImportFrom, ast.ClassDef, ast.Assign, ast.AnnAssign, ast.Expr)
    return {
        getattr(node, "name", ast.unparse(node))
        for node in statements
        if not isinstance(node, data) and "property" not in map(ast.unparse, getattr(node, "decorator_list", ()))
    }


def test_options_are_data():
    """Any room may import them: they hold dataclasses and constants, and load no torch."""
    every = [module for module in MODULES if module.startswith("options/")]
    assert len(every) > 2
    for module in every:
        source = MODULES[module].read_text()
        assert not behaviour(source), f"beags_plugin/{module}.py does work"
        others = {name for name in imported(source) if not name.startswith("beags_plugin.options.")}
        packages = {name.split(".")[0] for name in others} - {"__future__"}
        assert packages <= {*sys.stdlib_module_names, "tyro"}, f"beags_plugin/{module}.py imports {packages}"
    loaded = loaded_by("; ".join(f"import beags_plugin.{module.replace('/', '.')}" for module in every))
    assert not loaded & {"torch", "nerfstudio", "beags_plugin.system.errors"}


def test_the_check_of_options_sees_what_it_should():
    data = 'A = 1\n"""Text."""\n@dataclass\nclass B:\n    a: int = A\n    @property\n    def b(self): ...\n'
    assert behaviour(data) == set()
    assert behaviour(f"{data}    def c(self): ...\ndef d(): ...\nif A:\n    B = 1\n") == {"c", "d", "if A:\n    B = 1"}


def test_every_file_lies_in_a_room():
    assert {module for module in MODULES if "/" not in module} == {"__init__"}
    assert all(room_of(module) for module in MODULES if module != "__init__")


def test_only_the_plugin_and_what_stands_above_knows_nerfstudio():
    for module, path in MODULES.items():
        if module != "__init__" and room_of(module) not in NERFSTUDIO and not room_of(module).startswith("plugin"):
            names = {name.split(".")[0] for name in imported(path.read_text())}
            assert "nerfstudio" not in names, f"beags_plugin/{module}.py imports nerfstudio"


def loaded_by(statement: str) -> set[str]:
    code = f"import sys\n{statement}\nprint(*sorted(name for name in sys.modules))"
    return set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())


def test_what_stands_under_the_plugin_loads_without_nerfstudio():
    """Lazy imports of other packages aside, this is what runs where nerfstudio is not installed."""
    below = [
        module.removesuffix("/__init__").replace("/", ".")
        for module in MODULES
        if "/" in module and not room_of(module).startswith("plugin") and room_of(module) not in NERFSTUDIO
    ]
    assert len(below) > 100
    modules = loaded_by("; ".join(f"import beags_plugin.{name}" for name in [*below, "commands.cli"]))
    assert not {name for name in modules if name.split(".")[0] == "nerfstudio"}


def test_the_plugin_adds_nothing_heavy_to_a_nerfstudio_command():
    """What ns-* commands load anyway is free; the rest must be modules of ours and a few small ones."""
    pytest.importorskip("nerfstudio")
    others = "from nerfstudio.configs.external_methods import external_methods\nexternal_methods.clear()"  # slow
    before = loaded_by(f"{others}\nimport nerfstudio.configs.method_configs")
    assert "beags_plugin.plugin.methods" in before, "the entry points of this package are not installed"
    assert not before & {"open3d", "beags_plugin.sample.writer", "beags_benchmarks"}


def test_nothing_imports_the_distributions_beside_it():
    """They join by entry points alone, as anybody's package does."""
    for module, path in MODULES.items():
        names = {name.split(".")[0] for name in imported(path.read_text())}
        assert not names & {"beags_benchmarks", "beags_baselines"}, f"beags_plugin/{module}.py"


def test_tests_are_collected_without_the_distributions_beside_it():
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        named = re.search(r"^(?:from|import) (beags_(?:benchmarks|baselines))", text := path.read_text(), re.MULTILINE)
        assert named is None or f'pytest.importorskip("{named[1]}"' in text, path


def test_the_package_itself_imports_nothing():
    assert not loaded_by("import beags_plugin") & {"torch", "numpy", "nerfstudio"}
