"""Programs of others that read and write splat files and meshes, where they are installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import pytest


@cache
def node_package(name: str, variable: str) -> Path | None:
    """The folder of a package of npm: that of an environment variable, or one that npm has installed for all."""
    if named := os.environ.get(variable):
        return Path(named).absolute()
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        return None
    root = subprocess.run([npm, "root", "-g"], capture_output=True, text=True, timeout=60).stdout.strip()
    return found if root and (found := Path(root) / name).is_dir() else None


def by_node(program: str, *arguments: str | Path) -> Any:
    """Return what a module of JavaScript prints as JSON in its last line."""
    command = ["node", "--input-type=module", "-e", program, "--", *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr
    return json.loads(result.stdout.strip().splitlines()[-1])


def splat_transform() -> list[str] | None:
    """PlayCanvas' program: that of SPLAT_TRANSFORM, or one that npm has installed."""
    if named := os.environ.get("SPLAT_TRANSFORM"):
        return ["node", named] if named.endswith((".mjs", ".js")) else [named]
    found = shutil.which("splat-transform")
    return None if found is None else [found]


READ_BY_PLAYCANVAS = pytest.mark.skipif(
    splat_transform() is None or shutil.which("node") is None,
    reason="there is no splat-transform, so PlayCanvas' own program reads no file "
    "(npm install -g @playcanvas/splat-transform, or name its program in SPLAT_TRANSFORM)",
)


def converted(path: Path, target: Path, *options: str) -> Path:
    """``path`` as splat-transform writes it to ``target``."""
    command = splat_transform()
    assert command is not None
    arguments = [*command, "-w", "-g", "cpu", *options, path, target]
    result = subprocess.run(arguments, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr
    return target


def spz_library() -> Path | None:
    """The reference library of .spz, as its makers put it on npm: the folder of SPZ_LIBRARY, or installed for all."""
    return node_package("@adobe/spz", "SPZ_LIBRARY")


READ_BY_SPZ = pytest.mark.skipif(
    spz_library() is None,
    reason="there is no @adobe/spz, so the reference library reads no .spz "
    "(npm install -g @adobe/spz, or name its folder in SPZ_LIBRARY)",
)
_OPEN = """
const fs = await import("fs");
const { pathToFileURL } = await import("url");
const [library, path, rest] = process.argv.slice(1);
const spz = await (await import(pathToFileURL(library + "/dist/spz.js"))).default({ print: () => {} });
"""


def read_by_spz(path: Path) -> dict[str, Any]:
    """Return what the reference library reads, in the axes of .ply files: lists by the names of its fields."""
    program = (
        _OPEN
        + """
        const cloud = spz.loadSpzFromBuffer(new Uint8Array(fs.readFileSync(path)), { to: spz.CoordinateSystem.RDF });
        const names = ["positions", "scales", "rotations", "alphas", "colors", "sh"];
        const lists = Object.fromEntries(names.map((name) => [name, Array.from(cloud[name])]));
        console.log(JSON.stringify({ count: cloud.numPoints, degree: cloud.shDegree, ...lists }));
    """
    )
    return by_node(program, str(spz_library()), path)


def written_by_spz(path: Path, cloud: dict[str, Any], version: int) -> Path:
    """A file that the reference library writes of such lists."""
    program = (
        _OPEN
        + """
        const { version, count, degree, ...lists } = JSON.parse(fs.readFileSync(rest, "utf8"));
        const arrays = Object.fromEntries(Object.entries(lists).map(([name, list]) => [name, new Float32Array(list)]));
        const cloud = { numPoints: count, shDegree: degree, antialiased: false, extensions: [], ...arrays };
        const options = { version, from: spz.CoordinateSystem.RDF, sh1Bits: 8, shRestBits: 8 };
        fs.writeFileSync(path, spz.saveSpzToBuffer(cloud, options));
        console.log("{}");
    """
    )
    lists = path.with_suffix(".json")
    lists.write_text(json.dumps(cloud | {"version": version}))
    by_node(program, str(spz_library()), path, lists)
    return path
