"""The fuzz script finds nothing wrong with some degenerate scenes."""

from __future__ import annotations

import pytest

from beags_plugin.ops import extension

fuzz = pytest.importorskip("fuzz")


@pytest.mark.skipif(extension.load() is None, reason="the compiled extension is not built")
def test_nothing_is_wrong_with_some_scenes():
    findings = [fuzz.examine(number) for number in range(20)]
    assert [finding.failures for finding in findings if finding.failures] == []
    assert sum(bool(finding.unclear) for finding in findings) <= 4
