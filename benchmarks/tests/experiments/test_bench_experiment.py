"""The file of an experiment, and the trials that it plans."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")

from experiment_files import GOOD, masks_of, scene, written

from beags_benchmarks.experiments.experiment import experiment_names, load_experiment
from beags_benchmarks.experiments.scenes import SEEDS, TrialScene
from beags_benchmarks.experiments.trials import MODEL, Trial, plan, steps_of
from beags_plugin.plugin.presets import preset_config, preset_names
from beags_plugin.system.errors import UserError


@pytest.fixture
def experiment(tmp_path):
    return load_experiment(written(tmp_path, GOOD))


WITH_QUALITY = [name for name in experiment_names() if name != "classes"]  # classes measures cost alone
# experiments whose figures are reported; by all others something is chosen
REPORTING = {"presets", "compare", "compare-consistent"}


@pytest.mark.parametrize("name", WITH_QUALITY)
def test_scenes_for_choosing_and_for_reporting_are_kept_apart(name):
    experiment = load_experiment(name)
    seeds = {seed for _, seed in experiment.samples}
    assert seeds == set(SEEDS["reporting"]) if name in REPORTING else seeds <= set(SEEDS["choosing"])
    assert {family for family, _ in experiment.samples} == {"tabletop", "room"}
    assert not set(SEEDS["choosing"]) & set(SEEDS["reporting"]) and experiment.variants


@pytest.mark.parametrize(("name", "count"), [("presets", 3), ("compare", 2)])
def test_rows_named_after_presets_refine_as_these_do(name, count):
    """All of a file from one base; k of the paper's is scaled to the pixels."""
    experiment = load_experiment(name)
    rows = [variant for variant in experiment.variants if variant.name in preset_names()]
    assert len(rows) == count
    for row in rows:
        own, preset = (
            preset_config(name, overrides, Path()).model_config
            for name, overrides in ((experiment.preset, row.refine), (row.name, {}))
        )
        if row.name == "beags-paper":
            preset = replace(preset, prepare=replace(preset.prepare, k_pixels=own.prepare.k_pixels))
        base = {"base_steps", "base_lr_factor", "densify", "exposure"}
        assert {key for key, value in vars(own).items() if value != getattr(preset, key)} <= base, row.name


@pytest.mark.parametrize("name", WITH_QUALITY)
def test_every_length_of_refinement_has_its_control(name):
    """A gain in PSNR is one over as many steps with no loss of masks."""
    lengths: dict[bool, set[int]] = {True: set(), False: set()}
    experiment = load_experiment(name)
    for variant in experiment.variants:
        model = preset_config(experiment.preset, variant.refine, Path(name)).model_config
        control = not any(model.losses[loss].weight for loss in ("boundary", "occupancy", "silhouette"))
        assert control == ("neither loss" in variant.name)
        if model.refiner == "bea":
            lengths[control].add(model.refine_steps)
    assert lengths[False] == lengths[True]


def test_a_file_describes_variants_and_sweeps(experiment):
    variants = {variant.name: variant for variant in experiment.variants}
    assert list(variants) == [
        "none", "noisy", "k = 5, plain", "k = 10, plain", "k = 5, no R", "k = 10, no R", "damage = 0", "damage = 1.5",
    ]  # fmt: skip
    assert variants["none"].refine == {
        "pipeline.model.sh_degree": 0,
        "pipeline.model.refine_steps": 1,
        "pipeline.model.refiner": "none",
    }
    assert variants["noisy"].base == {"pipeline.model.sh_degree": 0, "pipeline.model.losses.normal.weight": 0.0}
    point = variants["k = 10, no R"]
    assert (point.sweep, point.line, point.x, point.damage) == ("k", "no R", 10.0, None)
    assert point.refine["pipeline.model.prepare.k"] == 10
    assert point.refine["pipeline.model.prepare.reprojection"] == "none"
    assert "pipeline.model.prepare.k" not in point.base
    assert (variants["damage = 1.5"].damage, variants["damage = 1.5"].x) == (1.5, 1.5)
    assert (
        experiment.samples == (("tabletop", 0),) and experiment.seeds == (42,) and experiment.sweeps == ("k", "damage")
    )


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('preset = "beags-tiny"', "", "has no preset"),
        ('description = "d"', "description = 3", "description must be str"),
        ('"pipeline.model.refiner"', '"pipeline.model.refinery"', "'refinery' is unknown) (did you mean refiner?)"),
        ('"pipeline.model.refiner" = "none"', '"pipeline.model.refiner" = 3', "must be str"),
        ("values = [5, 10]", "values = []", "sweep 'k': values must be"),
        ("values = [5, 10]", "values = [5, 2026-01-01]", "sweep 'k': values must be"),
        ("values = [5, 10]", f"values = [5, 1{400 * '0'}]", "sweep 'k': values must be"),
        ("[sweep.lines.plain]", "[sweep.lines]\nplain = 3", "sweep 'k': lines: plain must be a table"),
        ("[both]", '[paper]\nsource = "p"\ncolumns = 3\n[both]', "columns must be a list"),
        ('key = "pipeline.model.prepare.k"', 'key = "pipeline.model.prepare.kk"', "no config key"),
        ('key = "pipeline.model.prepare.k"', "", "sweep 'k': has no key"),
        ("relative_to_pixels = true", 'phase = "after"', "phase is 'after'"),
        ("relative_to_pixels = true", "absolute = true", "unknown entry 'absolute'"),
        ("[0.0, 1.5]", "[-1.0]", "degree of mask degradation is -1"),
        ("[0.0, 1.5]", "[99.0]", "number from 0 to 1"),
        ('name = "noisy"', 'name = "noisy"\nextra = 1', "variant 'noisy': has an unknown entry 'extra'"),
        ('name = "noisy"', 'name = "noisy"\npreset = "beags-fats"', "'beags-fats' (did you mean beags-fast?)"),
        ('name = "noisy"', 'name = "noisy"\ncontrol = "nose"', "refers to 'nose', which is no variant"),
        ("[both]", "[sample]\nseeds = [-1]\n[both]", "sample.seeds must be"),
        ("[both]", '[sample]\nseeds = "untouched"\n[both]', "'untouched': choose one of choosing, reporting"),
        ("[both]", '[sample]\nfamilies = ["attic"]\n[both]', "list of desk, room, tabletop, turntable"),
        ("[both]", "[sample]\nfamilies = 3\n[both]", "list of desk, room, tabletop, turntable"),
        ("[both]", "[sample]\nwidth = 2\n[both]", "sample: the sample's width is 2"),
        ("[both]", "[sample]\nwidht = 64\n[both]", "widht"),
        ("[both]", "[sample.of_seed.7]\nwidth = 64\n[both]", "sample.of_seed must have tables of the seeds 0 alone"),
        ("[both]", "[sample.of_seed]\n0 = 3\n[both]", "sample.of_seed: 0 must be a table"),
        ("[both]", "[sample.of_seed.0]\nshared_damage = 2\n[both]", "sample: the sample's shared_damage is 2"),
        ("[both]", '[paper]\nsource = "p"\ncolumns = ["a", "b"]\n[paper.rows]\nx = [[1, 2]]\n[both]', "row 'x' must"),
        ("[[variant]]", "[variant]", "is no TOML"),
        ("description", "=", "is no TOML"),
    ],
)
def test_a_mistake_in_the_file_gets_one_sentence(tmp_path, old, new, words):
    assert old in GOOD
    with pytest.raises(UserError) as error:
        load_experiment(written(tmp_path, GOOD.replace(old, new, 1)))
    assert words in str(error.value)
    assert "mine.toml" in str(error.value)


def test_an_experiment_like_another_has_its_variants():
    other = load_experiment("compare")
    alike = load_experiment("compare-consistent")
    key = "pipeline.model.prepare.reprojection"
    assert [v.name for v in alike.variants] == [v.name for v in other.variants] and alike.samples == other.samples
    assert {v.refine[key] for v in alike.variants} == {"auto"} and other.variants[0].refine[key] == "none"
    assert alike.description != other.description and alike.name == "compare-consistent"


def test_variants_share_bases_and_nothing_else(experiment):
    first, second = scene("a", "1"), scene("b", "2")
    runs = plan(experiment, [first, second], masks_of(first, second), "code")
    assert len(runs) == 2 * len(experiment.variants)
    of_first = [run.trial for run in runs if run.scene is first]
    assert len({trial.digest for trial in of_first}) == len(of_first)
    bases = {run.variant.name: run.trial.base.digest for run in runs if run.scene is first}
    assert bases["noisy"] != bases["none"]
    assert {base for name, base in bases.items() if name != "noisy"} == {bases["none"]}  # damaged masks need no other
    assert not {trial.digest for trial in of_first} & {run.trial.digest for run in runs if run.scene is second}
    base = of_first[0].base
    assert base.overrides[MODEL + "refine_steps"] == 0 and of_first[0].overrides[MODEL + "base_steps"] == 0
    assert steps_of(of_first[1]) == 7 and steps_of(base) == 1500


@pytest.mark.parametrize(
    "change",
    [
        {"overrides": {"a": 2}},
        {"seed": 1},
        {"code": "newer"},
        {"preset": "beags"},
        {"masks": Path("other")},
        {"scene": TrialScene("a", Path("/nowhere"), 2.0, "1")},
        {"scene": TrialScene("a", Path("/nowhere"), 1.0, "2")},
        {"scene": TrialScene("a", Path("/nowhere"), 1.0, "1", options={"layout": "llff"})},
    ],
)
def test_a_trial_is_another_when_anything_that_matters_changes(change):
    settings = {"scene": scene(), "preset": "beags-tiny", "overrides": {"a": 1}, "seed": 0, "code": "code"}
    former = Trial(**settings)
    assert Trial(**settings).digest == former.digest
    moved = TrialScene("renamed", Path("/elsewhere"), 1.0, "1")
    assert Trial(**{**settings, "scene": moved}).digest == former.digest
    assert Trial(**{**settings, **change}).digest != former.digest
