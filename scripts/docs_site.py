"""Write the sources of the documentation site: ``python scripts/docs_site.py [FOLDER]`` (build/docs/pages).

The sources are README.md, CONTRIBUTING.md, CHANGELOG.md, baselines/README.md and docs/*.md with the files that they
show, the notebook as a page, and a reference page for each extension point with its interface and built-in entries.
zensical.toml builds the site from them (``make docs``).
Links to other files of the repository become links to its public address, ``Repository`` under ``[project.urls]`` of
pyproject.toml; without one they become the file's path.
"""

from __future__ import annotations

import ast
import base64
import json
import re
import shutil
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PLACES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "baselines/README.md": "baselines.md",
}
LINK = re.compile(r"(?P<before>!?\[(?P<text>[^\]]*)\]\()(?P<goal>[^)\s#]+)(?P<anchor>#[^)\s]*)?(?P<after>[^)]*\))")
SOURCE = re.compile(r'(?P<before>src=")(?P<goal>[^"#]+)(?P<after>")')

PACKAGES = (ROOT / "beags_plugin", ROOT / "benchmarks" / "beags_benchmarks")
INTERFACES = {  # entry-point group to module
    "beags.rasterizers": "beags_plugin.rasterizers.interface",
    "beags.losses": "beags_plugin.losses.base",
    "beags.refiners": "beags_plugin.preparation.refiner",
    "beags.reprojections": "beags_plugin.masks.reprojection",
    "beags.layouts": "beags_plugin.data.layout",
    "beags.mask_sources": "beags_plugin.masks.sources.base",
    "beags.exporters": "beags_plugin.export.base",
    "beags.importers": "beags_plugin.importers.base",
    "beags.sample_families": "beags_plugin.sample.family",
    "beags.engines": "beags_benchmarks.experiments.engines.interface",
}


@dataclass(frozen=True)
class Extensions:
    """A registry in source code. kind: the user's word. builtin: name to "module:attribute"."""

    kind: str
    group: str
    builtin: Mapping[str, str]

    @property
    def page(self) -> str:
        return f"reference/{self.group.removeprefix('beags.')}.md"


def registries(package: Path) -> Iterator[Extensions]:
    """Read every ``Registry(kind, group, builtin)`` below ``package`` without importing anything."""
    for path in sorted(package.rglob("__init__.py")):
        for node in ast.walk(ast.parse(path.read_text("utf8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Registry":
                yield Extensions(*(ast.literal_eval(argument) for argument in node.args))


def reference(extensions: Extensions) -> str:
    """Return the page of an extension point, for mkdocstrings; raises ``KeyError`` for one without an interface."""
    title = f"{extensions.kind}s".capitalize()
    lines = [
        f"# {title}",
        f"Other packages add theirs in the entry-point group `{extensions.group}` ([Extending](../extending.md)).",
        "## Interface",
        f"::: {INTERFACES[extensions.group]}",
        "## Built in",
    ]
    for name, spec in extensions.builtin.items():
        lines += [f"### {name}", f"::: {spec.replace(':', '.')}\n    options:\n      members: false"]
    return "\n\n".join(lines) + "\n"


def rewritten(text: str, document: Path, repository: str, pictures: set[Path]) -> str:
    """Return a document's text with links that work in the site; adds the files that it shows to ``pictures``.

    document: its file, below ROOT. repository: the public address, or "". Broken links stay, so that the build of the
    site reports them.
    """
    docs = ROOT / "docs"

    def place(goal: str) -> str | Path | None:
        """Return a file's path in the site, the file itself if it is not in the site, None for other goals."""
        file = (document.parent / goal).resolve()
        if re.match(r"[a-z]+:", goal) or not file.exists() or not file.is_relative_to(ROOT):
            return None
        path = file.relative_to(ROOT)
        if str(path) in PLACES:
            return PLACES[str(path)]
        if not file.is_relative_to(docs) or file.is_dir():
            return path
        if file.suffix != ".md":
            pictures.add(file)
        return file.relative_to(docs).as_posix()

    def link(match: re.Match[str]) -> str:
        anchor = match["anchor"] or ""
        match goal := place(match["goal"]):
            case None:
                return match[0]
            case str():
                return f"{match['before']}{goal}{anchor}{match['after']}"
        if repository:
            return f"{match['before']}{repository}/blob/HEAD/{goal.as_posix()}{anchor}{match['after']}"
        words = match["text"]
        return f"`{goal.as_posix()}`" if words.strip("`") == goal.name else f"{words} (`{goal.as_posix()}`)"

    def source(match: re.Match[str]) -> str:
        goal = place(match["goal"])
        return f"{match['before']}{goal}{match['after']}" if isinstance(goal, str) else match[0]

    parts = re.split(r"(^```.*?^```$)", text, flags=re.MULTILINE | re.DOTALL)
    return "".join(part if part.startswith("```") else SOURCE.sub(source, LINK.sub(link, part)) for part in parts)


def notebook(path: Path, folder: Path) -> str:
    """Return a notebook as a page; writes its pictures into ``folder``."""
    parts: list[str] = []
    for cell in json.loads(path.read_text("utf8"))["cells"]:
        code = cell["cell_type"] == "code"
        text = "".join(cell["source"])
        parts.append(f"```python\n{text}\n```" if code else text)
        for output in cell.get("outputs", ()):
            if "text" in output:
                parts.append("```text\n" + "".join(output["text"]).rstrip() + "\n```")
            elif picture := output.get("data", {}).get("image/jpeg"):
                name = f"{path.stem}-{len(parts)}.jpg"
                (folder / name).write_bytes(base64.b64decode("".join(picture)))
                parts.append(f"![Output of the cell above]({name})")
    return "\n\n".join(parts) + "\n"


def write_pages(folder: Path) -> None:
    """Write all sources of the site into ``folder``, which is emptied first."""
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text("utf8"))["project"].get("urls", {})
    repository = urls.get("Repository", "").rstrip("/")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    pictures: set[Path] = set()
    pages = {f"{path.stem}.md": notebook(path, folder) for path in sorted((ROOT / "docs").glob("*.ipynb"))}
    for document in [*(ROOT / name for name in PLACES), *sorted((ROOT / "docs").glob("*.md"))]:
        place = PLACES.get(str(document.relative_to(ROOT)), document.name)
        pages[place] = rewritten(document.read_text("utf8"), document, repository, pictures)
    pages |= {each.page: reference(each) for package in PACKAGES for each in registries(package)}
    for place, text in pages.items():
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        (folder / place).write_text(text, "utf8")
    for file in pictures:
        copy = folder / file.relative_to(ROOT / "docs")
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, copy)


if __name__ == "__main__":
    write_pages(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "build/docs/pages")
