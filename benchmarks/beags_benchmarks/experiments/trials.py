"""Trials: single trainings, each identified by a digest of everything that determines its result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib.metadata import distributions
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from beags_benchmarks.experiments.experiment import Experiment, Variant
from beags_benchmarks.experiments.per_object import OBJECT, object_names
from beags_benchmarks.experiments.scenes import TrialScene
from beags_plugin.system.digests import code_digest, value_digest

MODEL = "pipeline.model."
FOCUS = "pipeline.datamanager.focus"
OPTIONS = MODEL + "refiner_options"


def code_of_trials() -> str:
    """Digest all code that determines a trial's result: beags, packages that extend it, and ``measure``."""
    points = (point for each in distributions() for point in each.entry_points if point.group.startswith("beags."))
    packages = {point.value.partition(":")[0].partition(".")[0] for point in points} - {__name__.partition(".")[0]}
    files = [Path(__file__).with_name("measure.py")]
    for name in sorted(packages):
        if (spec := find_spec(name)) is not None and spec.origin is not None:
            file = Path(spec.origin)
            files += sorted(file.parent.rglob("*.py")) if spec.submodule_search_locations else [file]
    return code_digest(*files)


@dataclass(frozen=True)
class Trial:
    """One training: a base or, with ``base``, a refinement that starts from that base.

    overrides: dotted config keys and their values. masks: folder that replaces the scene's masks. code: digest of the
    code that runs it.
    """

    scene: TrialScene
    preset: str
    overrides: Mapping[str, Any] = field(hash=False)
    seed: int
    code: str
    masks: Path | None = None
    base: Trial | None = None

    @cached_property
    def digest(self) -> str:
        """Return a digest that trials with equal results share; user data that were moved count as different."""
        from beags_plugin.plugin.presets import preset_files

        return value_digest(
            {
                "scene": self.scene.digest,
                "downscale": self.scene.downscale,
                "preset": [path.read_text("utf8") for path in preset_files(self.preset)],
                "overrides": {key: repr(value) for key, value in self.overrides.items()},  # repr writes infinity too
                "seed": self.seed,
                "code": self.code,
                "masks": self.masks and self.masks.name,  # the name has a digest
                "base": self.base and self.base.digest,
                **({"options": dict(self.scene.options)} if self.scene.options else {}),
            }
        )

    @property
    def folder_name(self) -> str:
        """Return the name of its folder among the trials."""
        scene = "".join(c if c.isalnum() or c in "._-" else "-" for c in self.scene.name)
        return f"{scene}-{'base' if self.base is None else 'refined'}-{self.digest[:12]}"


@dataclass(frozen=True)
class VariantTrial:
    """The trials of a variant on a scene with a seed: one, or one for each object.

    objects: names of these objects; empty for one trial of all.
    """

    variant: Variant
    scene: TrialScene
    seed: int
    trials: tuple[Trial, ...]
    objects: tuple[str, ...] = ()

    @property
    def trial(self) -> Trial:
        """Return the first trial."""
        return self.trials[0]


def plan(
    experiment: Experiment, scenes: Sequence[TrialScene], masks: Mapping[tuple[str, str], Path], code: str
) -> list[VariantTrial]:
    """Return every variant on every scene with every seed, scene after scene; variants share bases where they can.

    masks: (scene name, variant name) to the folder of the variant's own masks. code: digest of the code.
    """
    planned = []
    for scene in scenes:
        for seed in experiment.seeds:
            for variant in experiment.variants:
                base = base_trial(experiment, variant, scene, seed, code)
                other = masks[scene.name, variant.name] if variant.has_other_masks else None
                refine = {**variant.refine, MODEL + "base_steps": 0}
                objects = tuple(object_names(scene)) if variant.per_object else ()
                options = refine.get(OPTIONS, {})
                changes = [{**refine, OPTIONS: {**options, OBJECT: name}} for name in objects] or [refine]
                preset = variant.preset or experiment.preset
                trials = (Trial(scene, preset, each, seed, code, other, base) for each in changes)
                planned.append(VariantTrial(variant, scene, seed, tuple(trials), objects))
    return planned


def base_trial(experiment: Experiment, variant: Variant, scene: TrialScene, seed: int, code: str) -> Trial:
    """Return the training of a variant's base, which depends on masks only if it sees close-ups of objects."""
    changes = {FOCUS: "off", **variant.base, MODEL + "refine_steps": 0}
    photos = scene.photos if changes[FOCUS] == "off" else None
    return Trial(photos or scene, experiment.preset, changes, seed, code)


def steps_of(trial: Trial) -> int:
    """Return the number of training steps; raises ``UserError`` for overrides that the config does not take."""
    from beags_plugin.plugin.presets import preset_config

    model = preset_config(trial.preset, trial.overrides, Path(trial.scene.name)).model_config
    return model.base_steps + model.refine_steps
