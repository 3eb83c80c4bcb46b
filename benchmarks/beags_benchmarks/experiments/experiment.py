"""Experiments as TOML files describe them: scenes, a preset, and variants of its config."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from beags_benchmarks.experiments.scenes import SEEDS
from beags_plugin.system.errors import UserError, check_choice, meant
from beags_plugin.system.shipped import read_toml

FILES = Path(__file__).parent / "files"  # experiments of this package
PHASES = ("base", "refine", "both")
DAMAGE, CLASSES = "damage", "classes"  # axes without a config key: degree of mask damage, number of objects
_ENTRIES = {
    "description", "preset", "seeds", "sample", "variant", "sweep", "paper", "reference", "confidence",
    "objects", *PHASES,
}  # fmt: skip
_VARIANT = {"name", DAMAGE, "per_object", "preset", "control", *PHASES}
_SWEEP = {"name", "key", "values", "phase", "lines", "relative_to_pixels"}


@dataclass(frozen=True)
class Variant:
    """One way to train: its changes to the preset.

    base, refine: dotted config keys and their values. damage: degree of mask damage; None keeps the masks. classes:
    number of objects in artificial masks, which measure cost only.
    sweep, line, x: name of the sweep, its curve and the position on its axis, if the variant is a point of a sweep.
    per_object: a training for each object, whose name is the option "object" of the refiner.
    preset: preset of its refinement in place of the experiment's. control: the variant with which its PSNR is compared.
    """

    name: str
    base: Mapping[str, Any] = field(default_factory=dict)
    refine: Mapping[str, Any] = field(default_factory=dict)
    damage: float | None = None
    classes: int | None = None
    sweep: str = ""
    line: str = ""
    x: float | None = None
    per_object: bool = False
    preset: str | None = None
    control: str | None = None

    @property
    def has_other_masks(self) -> bool:
        """Return whether it is trained with masks other than the scene's own."""
        return self.damage is not None or self.classes is not None


@dataclass(frozen=True)
class PaperFigures:
    """Figures of the paper, for comparison. rows: variant to (IoU, BIoU) in percent for each column."""

    source: str
    columns: tuple[str, ...]
    rows: Mapping[str, tuple[tuple[float, float], ...]]


@dataclass(frozen=True)
class Experiment:
    """The content of ``files/<name>.toml``.

    samples, sample: family and seed of the generated scenes, and other options of ``VariedSample``. of_seed: options
    for scenes of one seed only. seeds: seeds of the training. reference: the variant with which the others' errors are
    compared. confidence, objects: whether to plot the masks' confidence, and the largest objects by each variant.
    relative_to_pixels: sweeps whose axis is also given per million training pixels.
    """

    name: str
    description: str
    preset: str
    samples: tuple[tuple[str, int], ...]
    sample: Mapping[str, Any]
    seeds: tuple[int, ...]
    variants: tuple[Variant, ...]
    reference: str | None = None
    confidence: bool = False
    objects: bool = False
    relative_to_pixels: frozenset[str] = frozenset()
    paper: PaperFigures | None = None
    of_seed: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)

    def header(self) -> dict[str, str]:
        """Return the first entries of every report: {"experiment", "description", "preset"}."""
        return {"experiment": self.name, "description": self.description, "preset": self.preset}

    @property
    def sweeps(self) -> tuple[str, ...]:
        """Return the names of the sweeps, in order."""
        return tuple(dict.fromkeys(variant.sweep for variant in self.variants if variant.sweep))


def experiment_names() -> list[str]:
    """Return the names of the experiments of this package, sorted."""
    return sorted(path.stem for path in FILES.glob("*.toml"))


def load_experiment(name: str) -> Experiment:
    """Read the experiment of that name, or the TOML file at that path.

    Every config key is checked on the preset, so that a typo is reported before anything is trained. Raises
    ``UserError`` if there is no such experiment, or its file has a mistake.
    """
    path = Path(name) if name.endswith(".toml") else FILES / f"{name}.toml"
    if not name.endswith(".toml"):
        check_choice(name, experiment_names(), "experiment", more=", or name a .toml file")
    experiment = _Reader(path).experiment()
    check_keys(experiment, path)
    return experiment


def check_keys(experiment: Experiment, source: Path) -> None:
    """Raise ``UserError`` unless the preset exists and takes every override of every variant."""
    from beags_plugin.plugin.presets import preset_config, preset_names

    try:
        for name in (experiment.preset, *(variant.preset for variant in experiment.variants if variant.preset)):
            check_choice(name, preset_names(), "preset")
    except UserError as error:
        raise UserError(f"{source}: {error}") from None
    for variant in experiment.variants:
        preset_config(experiment.preset, variant.base, source)
        preset_config(variant.preset or experiment.preset, variant.refine, source)


class _Reader:
    """Reads one file; every mistake is a ``UserError`` that names the file and the entry."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.content = read_toml(path, "experiment")
        if (other := self.value(self.content, "like", str, None)) is not None:
            self.content = self.changed(read_toml(path.with_stem(other), "experiment"))

    def changed(self, other: dict[str, Any]) -> dict[str, Any]:
        """Return another experiment's content, changed by the entries of this one."""
        both = {phase: {**other.get(phase, {}), **self.table(self.content, phase, "")} for phase in PHASES}
        own = {key: value for key, value in self.content.items() if key != "like"}
        return {**other, **own, **{phase: table for phase, table in both.items() if table}}

    def experiment(self) -> Experiment:
        content = self.content
        self.known(content, _ENTRIES, "")
        common = {phase: self.table(content, phase, "") for phase in PHASES}
        variants = [self.variant(entry, common) for entry in self.tables(content, "variant")]
        sweeps = self.tables(content, "sweep")
        for sweep in sweeps:
            variants += self.points(sweep, common)
        if not variants:
            raise self.wrong("has neither [[variant]] nor [[sweep]]: describe at least one.")
        names = [variant.name for variant in variants]
        if repeated := {name for name in names if names.count(name) > 1}:
            raise self.wrong(f"has two variants called {min(repeated)!r}: rename one of them.")
        reference = self.value(content, "reference", str, None)
        for named in (reference, *(variant.control for variant in variants)):
            if named is not None and named not in names:
                near = meant(named, names)
                raise self.wrong(f"refers to {named!r}, which is no variant{near}: name one of {', '.join(names)}.")
        sample = dict(self.table(content, "sample", ""))
        samples, of_seed = self.samples(sample), sample.pop("of_seed", {})
        return Experiment(
            name=self.path.stem,
            description=self.value(content, "description", str),
            preset=self.value(content, "preset", str),
            samples=samples,
            sample=self.checked_sample(sample),
            seeds=self.whole_numbers(content.get("seeds", [42]), "seeds"),
            variants=tuple(variants),
            reference=reference,
            confidence=self.value(content, "confidence", bool, False),
            objects=self.value(content, "objects", bool, False),
            relative_to_pixels=frozenset(s["name"] for s in sweeps if s.get("relative_to_pixels")),
            paper=self.paper(),
            of_seed=self.options_of_seeds(of_seed, sample, {str(seed) for _, seed in samples}),
        )

    def variant(self, entry: dict[str, Any], common: dict[str, dict[str, Any]]) -> Variant:
        name = self.value(entry, "name", str)
        self.known(entry, _VARIANT, f"variant {name!r}: ")
        own = {phase: self.table(entry, phase, f"variant {name!r}: ") for phase in PHASES}
        damage = entry.get(DAMAGE)
        each = self.value(entry, "per_object", bool, False, f"variant {name!r}: ")
        degree = None if damage is None else self.degree(damage)
        other = {key: self.value(entry, key, str, None, f"variant {name!r}: ") for key in ("preset", "control")}
        return Variant(name, *_by_phase(common, own), degree, per_object=each, **other)

    def points(self, sweep: dict[str, Any], common: dict[str, dict[str, Any]]) -> list[Variant]:
        """Return the variants of a sweep: every value on every line."""
        name = self.value(sweep, "name", str)
        where = f"sweep {name!r}: "
        self.known(sweep, _SWEEP, where)
        key = self.value(sweep, "key", str, where=where)
        phase = self.value(sweep, "phase", str, "refine", where)
        if phase not in PHASES:
            raise self.wrong(f"{where}phase is {phase!r}: choose one of {', '.join(PHASES)}.")
        values = sweep.get("values")
        if not isinstance(values, list) or not values or not all(map(_is_number, values)):
            raise self.wrong(f"{where}values must be a list of numbers.")
        given = self.table(sweep, "lines", where) or {"": {}}
        lines = {line: self.table(given, line, f"{where}lines: ") for line in given}
        variants = []
        for line, overrides in lines.items():
            for value in values:
                own = {**{p: {} for p in PHASES}, "refine": dict(overrides)}
                if key not in (DAMAGE, CLASSES):
                    own[phase][key] = value
                title = f"{name} = {value:g}" + (f", {line}" if line else "")
                damage = self.degree(value) if key == DAMAGE else None
                classes = int(value) if key == CLASSES else None
                variants.append(Variant(title, *_by_phase(common, own), damage, classes, name, line, float(value)))
        return variants

    def paper(self) -> PaperFigures | None:
        if "paper" not in self.content:
            return None
        table = self.table(self.content, "paper", "")
        self.known(table, {"source", "columns", "rows"}, "paper: ")
        columns = table.get("columns", [])
        if not isinstance(columns, list) or not all(isinstance(column, str) for column in columns):
            raise self.wrong("paper: columns must be a list of names.")
        rows = {}
        for name, pairs in self.table(table, "rows", "paper: ").items():
            if not (isinstance(pairs, list) and len(pairs) == len(columns) and all(map(_is_pair, pairs))):
                raise self.wrong(f"paper: the row {name!r} must have a pair [IoU, BIoU] for each of the columns.")
            rows[name] = tuple((float(iou), float(biou)) for iou, biou in pairs)
        return PaperFigures(self.value(table, "source", str, where="paper: "), tuple(columns), rows)

    def samples(self, sample: dict[str, Any]) -> tuple[tuple[str, int], ...]:
        """Take families and seeds out of the table; families alternate, so that the first scenes cover all."""
        from beags_plugin.sample import FAMILIES

        families, seeds = sample.pop("families", ["tabletop"]), sample.pop("seeds", [0])
        if not isinstance(families, list) or not families or not set(map(str, families)) <= set(FAMILIES.names()):
            raise self.wrong(f"sample.families must be a list of {', '.join(FAMILIES.names())}.")
        if isinstance(seeds, str):
            if seeds not in SEEDS:
                raise self.wrong(f"sample.seeds is {seeds!r}: choose one of {', '.join(SEEDS)}, or list whole numbers.")
            seeds = list(SEEDS[seeds])
        return tuple((family, seed) for seed in self.whole_numbers(seeds, "sample.seeds") for family in families)

    def options_of_seeds(self, tables: Any, sample: dict[str, Any], seeds: set[str]) -> dict[int, dict[str, Any]]:
        if not isinstance(tables, dict) or not tables.keys() <= seeds:
            raise self.wrong(f"sample.of_seed must have tables of the seeds {', '.join(sorted(seeds, key=int))} alone.")
        for seed in tables:
            self.checked_sample({**sample, **self.table(tables, seed, "sample.of_seed: ")})
        return {int(seed): options for seed, options in tables.items()}

    def checked_sample(self, options: dict[str, Any]) -> dict[str, Any]:
        from beags_benchmarks.samples.config import VariedSample

        try:
            VariedSample(**options, family="tabletop", seed=0).check()
        except (TypeError, UserError) as error:
            raise self.wrong(f"sample: {error}") from None
        return options

    def degree(self, value: Any) -> float:
        from beags_benchmarks.samples.damage import degradation_of_degree

        if not _is_number(value):
            raise self.wrong(f"damage is {value!r}: give a number (1 is mild, 2 strong).")
        try:
            degradation_of_degree(float(value))
        except UserError as error:
            raise self.wrong(f"damage: {error}") from None
        return float(value)

    def whole_numbers(self, values: Any, what: str) -> tuple[int, ...]:
        if not isinstance(values, list) or not all(type(value) is int and value >= 0 for value in values):
            raise self.wrong(f"{what} must be a list of whole numbers, 0 or more.")
        return tuple(values)

    def value(self, table: dict[str, Any], key: str, kind: type, default: Any = ..., where: str = "") -> Any:
        value = table.get(key, default)
        if value is ...:
            raise self.wrong(f"{where}has no {key}: add it.")
        if value is not default and type(value) is not kind:
            raise self.wrong(f"{where}{key} must be {kind.__name__}, not {value!r}.")
        return value

    def table(self, holder: dict[str, Any], key: str, where: str) -> dict[str, Any]:
        value = holder.get(key, {})
        if not isinstance(value, dict):
            raise self.wrong(f"{where}{key} must be a table, not {value!r}.")
        return value

    def tables(self, holder: dict[str, Any], key: str) -> list[dict[str, Any]]:
        value = holder.get(key, [])
        if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
            raise self.wrong(f"{key} must be written [[{key}]].")
        return value

    def known(self, table: dict[str, Any], entries: set[str], where: str) -> None:
        if unknown := sorted(set(table) - entries):
            raise self.wrong(f"{where}has an unknown entry {unknown[0]!r}: only {', '.join(sorted(entries))}.")

    def wrong(self, what: str) -> UserError:
        return UserError(f"the experiment {self.path}: {what}")


def _by_phase(common: dict[str, dict[str, Any]], own: dict[str, dict[str, Any]]) -> tuple[dict, dict]:
    """Return the overrides of base and refinement; a variant's own come after those of all variants."""
    return tuple({**common["both"], **common[p], **own["both"], **own[p]} for p in ("base", "refine"))  # type: ignore[return-value]


def _is_number(value: Any) -> bool:
    """Return whether a value is a number that a float can hold; large integers are not."""
    return type(value) in (int, float) and -sys.float_info.max <= value <= sys.float_info.max


def _is_pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))
