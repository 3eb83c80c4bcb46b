"""The paper's data sets as files: what they state, and mistakes in them."""

from __future__ import annotations

import pytest

pytest.importorskip("nerfstudio")

from beags_benchmarks.experiments.experiment import load_experiment
from beags_benchmarks.experiments.paper.data_sets import METHODS, NAMES, paper_folder, read_data_set, read_data_sets
from beags_plugin.data import LAYOUTS
from beags_plugin.data.layouts import mipnerf360
from beags_plugin.system.errors import UserError

DATA_SETS = {data_set.name: data_set for data_set in read_data_sets()}


def test_the_files_are_of_the_four_data_sets_and_of_the_methods():
    assert {path.stem for path in paper_folder().glob("*.toml")} == {*NAMES, METHODS}
    assert tuple(DATA_SETS) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_data_set_states_its_protocol_and_what_is_open(name):
    data_set = DATA_SETS[name]
    assert data_set.layout in LAYOUTS.names() and data_set.folders[0] == name
    assert data_set.metrics == ("extracted", "rendered", "psnr") and data_set.psnr is not None
    assert {"truth", "threshold"} <= set(data_set.open)
    for kind in ("extracted", "rendered"):
        assert max(pair[1] for pair in data_set.figures[kind].values()) < 100
        assert "bea-gs" in data_set.figures[kind]
    assert set(data_set.figures["extracted"]) - set(data_set.figures["rendered"]) == {"assignment alone"}


def test_figures_are_those_of_the_ablation():
    """The same figures stand in another file, typed in at another time."""
    paper = load_experiment("ablation").paper
    assert paper is not None
    for row, method in (("all", "bea-gs"), ("assignment alone", "assignment alone")):
        by_title = dict(zip(paper.columns, paper.rows[row], strict=True))
        assert by_title == {each.title: each.figures["extracted"][method] for each in DATA_SETS.values()}


def test_scenes_agree_with_the_layouts():
    assert tuple(DATA_SETS["mip360"].scenes) == mipnerf360.SCENES
    assert list(DATA_SETS["llff"].scenes) == list(DATA_SETS["llff"].held_out)
    assert sum(len(objects) for objects in DATA_SETS["llff"].scenes.values()) == 8
    assert [len(objects) for objects in DATA_SETS["lerf"].scenes.values()] == [7, 6, 10]


def test_every_method_has_figures_of_the_paper():
    methods = load_experiment(str(paper_folder() / f"{METHODS}.toml"))
    assert methods.preset == "beags-paper"
    assert {variant.name for variant in methods.variants} <= set(DATA_SETS["mip360"].figures["extracted"])


MISTAKES = {
    "no title": ('title = "Mip-NeRF 360"\n', "", "has no title: add it."),
    "unknown entry": ("title =", 'titel = "x"\ntitle =', r"unknown entry 'titel' \(did you mean title\?\)"),
    "width": ("split =", 'width = "wide"\nsplit =', "width must be a whole number above 0, not 'wide'."),
    "metrics": ('metrics = ["extracted",', 'metrics = ["extract",', "there is no metric 'extract'"),
    "masks": ('folder = "masks"', 'file = "masks"', "masks must be a table of source and of none but folder, instead"),
    "objects": ("bicycle = []", "bicycle = 3", "scene bicycle must be a list of texts, not 3."),
    "pair": ('"trace3d" = [87.1, 75.4]', '"trace3d" = [87.1]', "paper.extracted.trace3d must be two numbers"),
    "layout": ('layout = "mipnerf360"', 'layout = "mip"', "there is no layout 'mip'"),
    "no toml": ("title =", "title", "is no TOML"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_a_file_is_one_sentence(mistake, tmp_path):
    old, new, sentence = MISTAKES[mistake]
    text = (paper_folder() / "mip360.toml").read_text()
    assert text.count(old) == 1
    (tmp_path / "mine.toml").write_text(text.replace(old, new))
    with pytest.raises(UserError, match=sentence) as raised:
        read_data_set(tmp_path / "mine.toml")
    assert "\n" not in str(raised.value)


def test_another_data_set_is_refused():
    with pytest.raises(UserError, match="there is no data set 'lerfs' of the paper"):
        read_data_sets(["lerfs"])
