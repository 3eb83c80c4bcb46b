"""README's curve: a point for every row of every capture, drawn from the committed files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image
from places import ROOT

pytest.importorskip("nerfstudio")
image = pytest.importorskip("matplotlib.image")

from beags_benchmarks.studies import cost_curve
from beags_benchmarks.studies.page_tables import CAPTURES

RESULTS = ROOT / "docs" / "results"


@pytest.fixture
def clone(tmp_path):
    """A folder with the results that the curve is drawn from."""
    (tmp_path / "docs/results").mkdir(parents=True)
    for file in {file for file, _ in CAPTURES.values()}:
        (tmp_path / f"docs/results/{file}.json").write_text((RESULTS / f"{file}.json").read_text())
    return tmp_path


def test_the_curve_follows_the_figures(clone):
    first = image.imread(cost_curve.draw(clone))
    assert first.shape[0] > 200 and np.ptp(first) > 0.5
    file, scene = next(iter(CAPTURES.values()))
    path = clone / f"docs/results/{file}.json"
    content = json.loads(path.read_text())
    (row,) = (row for row in content["rows"] if (row["variant"], row["scene"]) == ("beags-fast", scene))
    row["extracted_biou_after"] = 0.1
    path.write_text(json.dumps(content))
    assert not np.array_equal(first, image.imread(cost_curve.draw(clone)))


def test_the_committed_curve_has_the_committed_figures(clone):
    """The picture keeps a digest of its points: it cannot fall behind README's table."""
    with Image.open(ROOT / "docs/images/cost.png") as committed, Image.open(cost_curve.draw(clone)) as drawn:
        assert committed.info["Description"] == drawn.info["Description"] == cost_curve.digest()


def test_a_row_that_lacks_is_named(clone):
    file, _ = next(iter(CAPTURES.values()))
    (clone / f"docs/results/{file}.json").write_text('{"rows": []}')
    with pytest.raises(KeyError, match="assignment alone"):
        cost_curve.draw(clone)
