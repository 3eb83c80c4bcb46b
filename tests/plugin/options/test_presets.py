"""Presets: every file loads, every key is checked, and nerfstudio gets what it expects."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from places import ROOT

pytest.importorskip("nerfstudio")

from beags_plugin.losses import LOSSES
from beags_plugin.plugin import methods
from beags_plugin.plugin.options.config import BeagsTrainerConfig, base_config
from beags_plugin.plugin.presets import load_preset, override, preset_files, preset_names
from beags_plugin.refiners import REFINERS
from beags_plugin.system.errors import UserError
from beags_plugin.system.shipped import read_toml, shipped_folder


def write(folder, text):
    (folder / "mine.toml").write_text(text)
    return folder


def test_the_documented_presets_exist():
    documented = {"beags", "beags-base", "beags-fast", "beags-paper", "beags-refine", "beags-tiny"}
    assert documented <= set(preset_names())


def test_every_preset_is_a_name_of_ns_train():
    """The checkout's pyproject.toml names all presets, whatever is installed."""
    file = ROOT / "pyproject.toml"
    if not file.exists():
        pytest.skip("no pyproject.toml beside the tests")
    project = read_toml(file, "project")
    points = project["project"]["entry-points"]["nerfstudio.method_configs"]
    assert points == {name: f"beags_plugin.plugin.methods:{name.replace('-', '_')}" for name in preset_names()}


def test_the_papers_preset_changes_nothing_but_what_is_chosen_by_size_and_exposure():
    """The documented base config is the paper's; other extensions of ours are off."""
    model, documented = load_preset("beags-paper").config.pipeline.model, base_config().pipeline.model
    assert (model.prepare.reprojection, documented.prepare.reprojection) == ("pairwise", "auto")
    assert (model.exposure, documented.exposure) == ("off", "auto")
    assert replace(model, exposure="auto", prepare=replace(model.prepare, reprojection="auto")) == documented
    assert model.losses["silhouette"].weight == 0.0


def test_the_papers_preset_pins_every_choice_that_is_an_option():
    """Those of section 11 of docs/method.md, but for the choices of other presets."""
    rows = (ROOT / "docs/method.md").read_text("utf-8").split("## 11. ")[1].split("|---|---|---|")[1].splitlines()
    switches = [row.split("|")[3] for row in rows if row and not row.startswith("| `beags-")]
    options = set(re.findall(r"`(near|far|prepare\.\w+)", " ".join(switches)))
    pinned = read_toml(shipped_folder("method_configs") / "beags-paper.toml", "preset")["overrides"]
    assert {"near", "prepare.tau"} <= options
    assert {f"pipeline.model.{option}" for option in options} <= set(pinned)


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_loads_and_names_itself(name):
    spec = load_preset(name)
    assert isinstance(spec.config, BeagsTrainerConfig)
    assert spec.config.method_name == name
    assert spec.description
    model = spec.config.pipeline.model
    assert set(model.losses) <= set(LOSSES.names())
    assert model.refiner in REFINERS.names()
    assert model.base_steps + model.refine_steps > 0
    groups = {"means", "features_dc", "features_rest", "opacities", "scales", "quats"}
    assert set(spec.config.optimizers) == groups


def test_entry_points_give_the_presets():
    assert methods.beags_tiny.config.method_name == "beags-tiny"
    assert methods.beags.config.pipeline.model.base_steps == 7_500


def test_the_presets_of_one_phase_are_that_phase_of_beags():
    """The options of beags-base and beags-refine together are those of beags."""

    whole, base, refine = (load_preset(name).config.pipeline.model for name in ("beags", "beags-base", "beags-refine"))
    assert base == replace(whole, refine_steps=0) and refine == replace(whole, base_steps=0)


def test_a_preset_takes_the_overrides_of_the_one_it_is_like(tmp_path):
    texts = {
        "first": "[overrides]\n'pipeline.model.base_steps' = 7\n'pipeline.model.refine_steps' = 8",
        "second": "like='first'\n[overrides]\n'pipeline.model.refine_steps' = 9",
        "third": "like='second'",
    }
    for name, text in texts.items():
        (tmp_path / f"{name}.toml").write_text(f"description='{name}'\n{text}")
    spec = load_preset("third", tmp_path)
    assert (spec.config.method_name, spec.description.split()[0]) == ("third", "third")
    assert (spec.config.pipeline.model.base_steps, spec.config.pipeline.model.refine_steps) == (7, 9)
    assert [path.stem for path in preset_files("third", tmp_path)] == ["third", "second", "first"]
    (tmp_path / "first.toml").write_text("description='x'\nlike='third'")
    with pytest.raises(UserError, match="is like itself through .*first.toml: remove one entry like"):
        load_preset("third", tmp_path)


def test_presets_do_not_share_state():
    first, second = load_preset("beags"), load_preset("beags")
    first.config.pipeline.model.losses["boundary"].weight = 7.0
    assert second.config.pipeline.model.losses["boundary"].weight == 0.5


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('description="x"\n[overrides]\n"pipeline.model.no_such" = 1', "no_such"),
        ('description="x"\n[overrides]\n"pipeline.model.losses.nothing.weight" = 1.0', "nothing"),
        ('description="x"\n[overrides]\n"pipeline.model.base_steps" = "many"', "must be int"),
        ('description="x"\nextra=1', "unknown entries"),
        ("description=", "is no TOML"),
        ('description="x"\nlike="nobody"', "nobody.toml cannot be read"),
    ],
)
def test_a_wrong_preset_is_refused_in_one_sentence(tmp_path, text, words):
    with pytest.raises(UserError, match=words):
        load_preset("mine", write(tmp_path, text))


def test_override_reaches_frozen_and_nested_configs(tmp_path):
    config = base_config()
    override(config, "pipeline.model.prepare.k", 50, tmp_path)
    override(config, "pipeline.model.losses.boundary.weight", 1, tmp_path)
    override(config, "optimizers.means.optimizer.lr", 0.5, tmp_path)
    assert config.pipeline.model.prepare.k == 50
    assert config.pipeline.model.losses["boundary"].weight == 1.0
    assert config.optimizers["means"]["optimizer"].lr == 0.5
    assert base_config().pipeline.model.prepare.k == 2000
