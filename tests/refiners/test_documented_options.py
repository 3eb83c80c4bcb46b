"""docs/refiners.md names every option of every refiner that it has a section of, with its default."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

import pytest

from beags_plugin.refiners import REFINERS

DOCUMENT = Path(__file__).resolve().parents[2] / "docs/refiners.md"
OURS = {"bea", "none"}  # this method, and assignment alone


def sections() -> dict[str, str]:
    """Return the sections by the name of their refiner: that of the heading, without spaces and dots."""
    parts = re.split(r"^## (.+)$", DOCUMENT.read_text("utf8"), flags=re.M)
    pairs = zip(parts[1::2], parts[2::2], strict=True)
    return {re.sub(r"[ .-]+", "-", title.lower()): text for title, text in pairs}


@pytest.mark.parametrize("name", sorted(set(REFINERS.names()) - OURS))
def test_options_are_listed_with_their_defaults(name):
    table = [line.split("|") for line in sections()[name].splitlines() if line.startswith("| `")]
    defaults = {re.findall("`(.+?)`", cells[1])[0]: cells[2].replace("`", "").replace(",", "") for cells in table}
    kind = REFINERS.get(name)
    expected = {field.name: field.default for field in fields(kind)}
    assert set(defaults) == set(expected)
    for option, default in expected.items():
        shown = {"": "empty"}.get(default, f"{default:g}" if isinstance(default, float) else str(default))
        assert re.match(rf" {re.escape(shown)}\b", defaults[option]), (option, default, defaults[option])
