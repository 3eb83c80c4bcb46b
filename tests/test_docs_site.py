"""The sources of the documentation site: its pages, its navigation, its reference; and what tells the version."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import pytest
from places import ROOT

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

if not (ROOT / "zensical.toml").exists():
    pytest.skip("no documents beside the tests", allow_module_level=True)

from scripts import docs_site


@pytest.fixture(scope="module")
def pages(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pages")
    docs_site.write_pages(folder)
    return folder


def places(entries: list) -> list[str]:
    """Return the pages of a navigation, in its order."""
    found = []
    for entry in entries:
        ((_, below),) = entry.items()
        found += [below] if isinstance(below, str) else places(below)
    return found


def test_the_navigation_leads_to_every_page_once(pages):
    settings = tomllib.loads((ROOT / "zensical.toml").read_text("utf8"))
    written = {path.relative_to(pages).as_posix() for path in pages.rglob("*.md")}
    assert len(written) > 20
    assert sorted(places(settings["project"]["nav"])) == sorted(written)


def test_every_registry_has_a_page_with_its_interface_and_what_is_built_in(pages):
    from beags_plugin.refiners import REFINERS

    found = {each.group: each for package in docs_site.PACKAGES for each in docs_site.registries(package)}
    assert set(found) == set(docs_site.INTERFACES)
    assert set(found[REFINERS.group].builtin) <= set(REFINERS.names())
    for each in found.values():
        text = (pages / each.page).read_text("utf8")
        modules = re.findall(r"^::: ([\w.]+)$", text, re.MULTILINE)
        assert importlib.util.find_spec(modules[0]) is not None
        assert modules[1:] == [spec.replace(":", ".") for spec in each.builtin.values()]


@pytest.mark.parametrize(
    ("document", "text", "alone", "published"),
    [
        ("README.md", "[a](docs/data.md#x)", "[a](data.md#x)", None),
        ("README.md", "![a](docs/images/pick.jpg)", "![a](images/pick.jpg)", None),
        ("README.md", '<img src="docs/images/pick.jpg">', '<img src="images/pick.jpg">', None),
        ("docs/viewer.md", "[a](../README.md#measured)", "[a](index.md#measured)", None),
        ("docs/viewer.md", "[a](../CONTRIBUTING.md)", "[a](contributing.md)", None),
        ("docs/comparison.md", "[a](../baselines/README.md#options)", "[a](baselines.md#options)", None),
        ("docs/results.md", "[a](../notes/README.md)", "a (`notes/README.md`)", "[a](R/blob/HEAD/notes/README.md)"),
        ("docs/cuda.md", "[`Makefile`](../Makefile)", "`Makefile`", "[`Makefile`](R/blob/HEAD/Makefile)"),
        ("docs/cuda.md", "[a](https://b.c/d) [e](#f)", "[a](https://b.c/d) [e](#f)", None),
        ("docs/cuda.md", "[a](../nowhere.md)", "[a](../nowhere.md)", None),
        ("docs/cuda.md", "```\n[a](../Makefile)\n```", "```\n[a](../Makefile)\n```", None),
    ],
)
def test_links_hold_in_the_site(document, text, alone, published):
    assert docs_site.rewritten(text, ROOT / document, "", set()) == alone
    assert docs_site.rewritten(text, ROOT / document, "R", set()) == (published or alone)


def test_no_page_has_diagrams_that_the_site_would_show_as_code(pages):
    languages = {
        word for page in pages.rglob("*.md") for word in re.findall(r"^```(\w+)", page.read_text("utf8"), re.M)
    }
    assert languages <= {"python", "text"}


def test_files_that_pages_show_lie_beside_them(pages):
    assert (pages / "images/pick.jpg").is_file()
    assert not (pages / "pictures").exists()


def test_docstrings_list_their_own_names_alone():
    pytest.importorskip("griffe", reason="griffe is missing: make docs")
    from scripts.docstring_lists import listed

    text = "Do.\n\nsize, shape [H, W] int32: of it.\n  More: words. other: kept. depth: of it.\n\nElse: no."
    assert listed(text, {"size", "shape", "depth"}) == (
        "Do.\n\n- **size, shape [H, W] int32**: of it. More: words. other: kept.\n- **depth**: of it.\n\nElse: no."
    )
    assert listed("Do.", {"size"}) == "Do."


def test_one_version_is_told_everywhere():
    import beags_plugin

    version = tomllib.loads((ROOT / "pyproject.toml").read_text("utf8"))["project"]["version"]
    assert beags_plugin.__version__ == version
    baselines = tomllib.loads((ROOT / "baselines/pyproject.toml").read_text("utf8"))
    assert baselines["project"]["version"] == version
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text("utf8")
    assert re.findall(r"^## ([\d.]+)", (ROOT / "CHANGELOG.md").read_text("utf8"), re.MULTILINE)[0] == version
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    assert {name for page in pages for name in re.findall(r"beags-([\d.]+)-cp", page.read_text("utf8"))} <= {version}
