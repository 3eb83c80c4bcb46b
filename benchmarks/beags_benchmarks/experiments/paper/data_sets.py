"""The paper's data sets from files/paper/: scenes, resolution, split, objects, truth, figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from beags_benchmarks.experiments.experiment import FILES
from beags_plugin.data import LAYOUTS
from beags_plugin.system.errors import UserError, check_choice, meant
from beags_plugin.system.shipped import read_toml

NAMES = ("mip360", "llff", "lerf", "3dovs")
METHODS = "methods"  # name of the experiment of the methods
METRICS = ("extracted", "rendered", "psnr")
_ENTRIES = {
    "title", "folders", "layout", "images", "width", "split", "eval_interval", "held_out", "metrics", "masks",
    "truth", "scenes", "open", "paper",
}  # fmt: skip


@dataclass(frozen=True)
class MaskSource:
    """The masks to train on. source: their source in the paper. folder: folder of id images below the scene.

    instead: folder of the download that replaces a missing ``folder``, or "". instead_source: source of that. prompts:
    the paper's prompts. texts: whether the objects' names are the prompts.
    """

    source: str
    folder: str
    instead: str = ""
    instead_source: str = ""
    prompts: str = ""
    texts: bool = False


@dataclass(frozen=True)
class TruthSource:
    """The masks to score with. source: their source in the paper.

    visible: path for visible masks below the scene. get: a command that downloads them, or "".
    """

    source: str
    visible: str = "ground_truth/visible/<object>/<photo>.png"
    get: str = ""


@dataclass(frozen=True)
class PaperDataSet:
    """The content of ``files/paper/<name>.toml``.

    folders: names below the data root: our name, then those of downloads. layout, eval_interval: options of
    ``beags-data``. images: folder of the photos. width: pixels to which wider photos are scaled down; None keeps all.
    split: a description. held_out: scene to the stem of a photo that is held out besides. metrics: those of ``METRICS``
    that the paper has. scenes: scene to its objects; empty if the scene's own class names apply. open: choices that the
    paper does not state, and ours. figures: "extracted" and "rendered" to method to (IoU, BIoU) in percent. psnr: dB
    before and after refinement, or None.
    """

    name: str
    title: str
    folders: tuple[str, ...]
    layout: str
    images: str
    split: str
    metrics: tuple[str, ...]
    masks: MaskSource
    truth: TruthSource
    scenes: Mapping[str, tuple[str, ...]]
    width: int | None = None
    eval_interval: int | None = None
    held_out: Mapping[str, str] = field(default_factory=dict)
    open: Mapping[str, str] = field(default_factory=dict)
    figures: Mapping[str, Mapping[str, tuple[float, float]]] = field(default_factory=dict)
    psnr: tuple[float, float] | None = None

    def folder(self, root: Path) -> Path:
        """Return the folder of the data set below the data root: the first that exists, else the one with our name."""
        return next((root / name for name in self.folders if (root / name).is_dir()), root / self.folders[0])


def paper_folder() -> Path:
    """Return the folder of the data sets' files."""
    return FILES / "paper"


def read_data_sets(names: Sequence[str] = ()) -> list[PaperDataSet]:
    """Read the data sets of these names, all if empty; raises ``UserError`` for an unknown name or a wrong file."""
    for name in names:
        check_choice(name, NAMES, "data set", " of the paper")
    return [read_data_set(paper_folder() / f"{name}.toml") for name in NAMES if name in (names or NAMES)]


def read_data_set(path: Path) -> PaperDataSet:
    """Read one file; raises a ``UserError`` that names the file and the wrong entry."""
    content = read_toml(path, "data set")
    try:
        return _data_set(path.stem, content)
    except KeyError as error:
        raise UserError(f"the data set {path} has no {error.args[0]}: add it.") from None
    except (TypeError, ValueError) as error:
        raise UserError(f"the data set {path}: {error}") from None


def _data_set(name: str, content: Mapping[str, Any]) -> PaperDataSet:
    if unknown := sorted(set(content) - _ENTRIES):
        near = meant(unknown[0], _ENTRIES)
        raise ValueError(f"unknown entry {unknown[0]!r}{near}: only {', '.join(sorted(_ENTRIES))}.")
    LAYOUTS.check(content["layout"])
    metrics = _texts(content["metrics"], "metrics")
    for metric in metrics:
        check_choice(metric, METRICS, "metric")
    figures = dict(content.get("paper", {}))
    psnr = figures.pop("psnr", None)
    if unknown := sorted(set(figures) - set(METRICS[:2])):
        raise ValueError(f"paper has an unknown entry {unknown[0]!r}: only psnr, {', '.join(METRICS[:2])}.")
    folders = _texts(content["folders"], "folders")
    if not folders or not content["scenes"]:
        raise ValueError("folders and scenes must each name at least one.")
    return PaperDataSet(
        name=name,
        title=_text(content["title"], "title"),
        folders=folders,
        layout=content["layout"],
        images=_text(content["images"], "images"),
        split=_text(content["split"], "split"),
        metrics=metrics,
        masks=_source(MaskSource, content["masks"], "masks"),
        truth=_source(TruthSource, content["truth"], "truth"),
        scenes={scene: _texts(objects, f"scene {scene}") for scene, objects in content["scenes"].items()},
        width=_whole(content.get("width"), "width"),
        eval_interval=_whole(content.get("eval_interval"), "eval_interval"),
        held_out={scene: _text(stem, f"held_out.{scene}") for scene, stem in content.get("held_out", {}).items()},
        open={what: _text(choice, f"open.{what}") for what, choice in content.get("open", {}).items()},
        figures={
            metric: {method: _pair(pair, f"paper.{metric}.{method}") for method, pair in rows.items()}
            for metric, rows in figures.items()
        },
        psnr=None if psnr is None else _pair(psnr, "paper.psnr"),
    )


def _source(kind: type, table: Any, what: str) -> Any:
    known = [each.name for each in fields(kind)]
    if not isinstance(table, dict) or "source" not in table or not set(table) <= set(known):
        raise ValueError(f"{what} must be a table of source and of none but {', '.join(known[1:])}.")
    return kind(**table)


def _text(value: Any, what: str) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{what} must be a text, not {value!r}.")
    return value


def _texts(value: Any, what: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(each, str) for each in value):
        raise TypeError(f"{what} must be a list of texts, not {value!r}.")
    return tuple(value)


def _whole(value: Any, what: str) -> int | None:
    if value is not None and (type(value) is not int or value < 1):
        raise TypeError(f"{what} must be a whole number above 0, not {value!r}.")
    return value


def _pair(value: Any, what: str) -> tuple[float, float]:
    numbers = isinstance(value, list) and len(value) == 2 and all(type(each) in (int, float) for each in value)
    if not numbers:
        raise TypeError(f"{what} must be two numbers, not {value!r}.")
    return float(value[0]), float(value[1])
