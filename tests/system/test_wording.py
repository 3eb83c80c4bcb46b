"""Nouns and verbs agree with their numbers."""

from __future__ import annotations

import pytest

from beags_plugin.system.wording import amount, verb


@pytest.mark.parametrize(("count", "said"), [(0, "0 masks"), (1, "1 mask"), (2, "2 masks")])
def test_a_noun_agrees_with_its_number(count, said):
    assert amount(count, "mask") == said
    assert amount(count, "mask", "are") == f"{said} {'is' if count == 1 else 'are'}"


@pytest.mark.parametrize(("plural", "one"), [("show", "shows"), ("are", "is"), ("have", "has"), ("do", "does")])
def test_a_verb_agrees_with_its_number(plural, one):
    assert verb(1, plural) == one and verb(2, plural) == plural == verb(0, plural)
