"""The code cites sections of docs/method.md that exist, and links between the documents lead somewhere."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
CITING = ("beags_plugin", "baselines", "tests", "benchmarks", "method_configs")
SUFFIXES = {".py", ".h", ".cpp", ".cu", ".cuh", ".toml", ".yaml", ".yml"}
ROOMS = (".", "baselines", "benchmarks", "docs", "notes")
DOCUMENTS = [path for room in ROOMS for path in sorted((ROOT / room).glob("*.md"))]

# "section 4", "sections 2, 3 and 5"; of other papers than ours only with dotted numbers ("sections 3.7.2, 4.4").
CITATION = re.compile(r"\bsections?\s+(\d[\d.]*(?:(?:,\s*|,?\s+and\s+)\d[\d.]*)*)", re.IGNORECASE)
HEADING = re.compile(r"^#{1,6}\s+(.*?)\s*#*\s*$", re.MULTILINE)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)(?:\s+\"[^\"]*\")?\)")


def sources() -> list[Path]:
    return [path for room in CITING for path in sorted((ROOT / room).rglob("*")) if path.suffix in SUFFIXES]


def cited(text: str) -> Iterator[str]:
    """Return the section numbers of the method that a source cites; a comment may break a citation over two lines."""
    joined = re.sub(r"\n\s*(?:#|//|\*)?\s*", " ", text)
    for match in CITATION.finditer(joined):
        yield from (number for number in re.findall(r"\d+(?:\.\d+)*", match[1]) if "." not in number)


def test_the_documents_have_each_heading_that_comments_name():
    """A file of docs/ or notes/, a comma, then headings in quotes; a comment may break them over two lines."""
    lost, count = [], 0
    for path in [*sources(), *sorted((ROOT / "benchmarks").rglob("*.md"))]:
        joined = re.sub(r"\s*\n\s*(?:#|//|\*)?\s*", " ", path.read_text("utf-8"))
        for name, titles in re.findall(r'((?:docs|notes)/[\w-]+\.md),((?:,? (?:and )?"[^"]+")+)', joined):
            for title in re.findall(r'"([^"]+)"', titles):
                count += 1
                if f"# {title}\n" not in (ROOT / name).read_text("utf-8"):
                    lost.append(f"{path.relative_to(ROOT)}: {name}, {title!r}")
    assert count > 5, "the pattern no longer finds the headings"
    assert not lost


def without_code(markdown: str) -> str:
    return re.sub(r"^(```|~~~).*?^\1", "", markdown, flags=re.MULTILINE | re.DOTALL)


def anchors(markdown: str) -> set[str]:
    """Return the anchors of a document's headings, formed as GitHub forms them."""
    found: set[str] = set()
    for title in HEADING.findall(without_code(markdown)):
        title = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title)  # Only the text of a link counts.
        base = re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
        again = sum(1 for known in found if re.fullmatch(re.escape(base) + r"(-\d+)?", known))
        found.add(f"{base}-{again}" if again else base)
    return found


def test_the_method_has_each_section_that_the_code_cites():
    headings = re.findall(r"^## (\d+)\. ", (ROOT / "docs/method.md").read_text("utf-8"), flags=re.MULTILINE)
    numbers = [(path, number) for path in sources() for number in cited(path.read_text("utf-8"))]
    assert len(numbers) > 50, "the pattern no longer finds the citations"
    lost = [f"{path.relative_to(ROOT)}: section {number}" for path, number in numbers if number not in headings]
    assert not lost


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_between_documents_resolve(document: Path):
    text = document.read_text("utf-8")
    lost = []
    for link in LINK.findall(without_code(text)):
        if re.match(r"[a-z]+:", link):  # https:, mailto:
            continue
        name, _, anchor = link.partition("#")
        goal = document.parent / name if name else document
        exists = goal.exists() and goal.resolve().is_relative_to(ROOT)
        if not exists or (anchor and anchor not in anchors(goal.read_text("utf-8"))):
            lost.append(link)
    assert not lost


def test_tests_that_scripts_call_exist():
    """Lists such as tests/ops/test_{a,b}.py, in scripts that nobody runs every day."""
    for script in sorted((ROOT / "scripts").glob("*.sh")):
        for pattern in re.findall(r"tests/[\w/]+(?:\{[\w,]+\})?[\w]*\.(?:py|cpp|supp)", script.read_text("utf8")):
            names = re.search(r"\{([\w,]+)\}", pattern)
            for name in names[1].split(",") if names else [""]:
                path = re.sub(r"\{[\w,]+\}", name, pattern)
                assert (ROOT / path).is_file(), f"{script.name} calls {path}, which is not there"


@pytest.mark.parametrize("page", ["README.md", "docs/viewer.md"])
def test_what_runs_of_others_may_do_stands_before_the_command_that_opens_one(page):
    before, command, _ = " ".join((ROOT / page).read_text("utf-8").split()).partition(" beags view outputs/... ")
    assert command and "listens on all addresses" in before
    assert re.search(r"(execute|run code).{0,40}name", before)
