"""``beags masks check``: errors and contradictions in the masks of a scene, found before training on them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from beags_plugin.data.dataset import Dataset
from beags_plugin.data.files import image_size, photo_names
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.labels.classes import read_classes
from beags_plugin.masks.check.consistency import Agreement
from beags_plugin.masks.check.contradictions import (
    Area,
    Contradiction,
    contradicted,
    contradictions,
    issues_of,
    settle,
)
from beags_plugin.masks.check.disagreement import views_against_others
from beags_plugin.masks.check.files import MOST_IDS, Coverage, MaskFiles, check_files
from beags_plugin.masks.check.issues import LEVELS, Issue, ordered, percent
from beags_plugin.objects.compare_views import agreements, pointed, points_in_space, tracks_of, turned
from beags_plugin.objects.reproject_masks import ReprojectedRun, ReprojectionOptions, reproject_run
from beags_plugin.pictures.masks import Changed, Pointed, contradicted_picture, coverage_picture
from beags_plugin.runs.run import Run
from beags_plugin.system.errors import writing
from beags_plugin.system.progress import progress_bar
from beags_plugin.system.wording import amount
from beags_plugin.views.data_options import DataOptions
from beags_plugin.views.poses import PosedViews
from beags_plugin.views.scene_data import SceneData
from beags_plugin.views.tracks import Tracks, features_of

MOST_PICTURES = 6  # views in contradicted.png
MOST_OBJECTS = 40  # objects that are printed


@dataclass
class Report:
    """What the check found.

    names: class id to name. trained: False for held-out views. contradictions: views whose masks the others contradict,
    the worst first, at tracked points, then, with a trained run, at its depths, in ``areas``. compared: a sentence on
    the tracked points. tracked: whether there are any. pointed, framed: the worst views at points and in areas, for
    ``contradicted_picture``.
    """

    data: Path
    stems: list[str]
    names: dict[int, str]
    trained: list[bool]
    coverage: Coverage
    issues: list[Issue]
    contradictions: list[Contradiction] = field(default_factory=list)
    areas: list[Area] = field(default_factory=list)
    compared: str = ""
    tracked: bool = False
    pointed: list[Pointed] = field(default_factory=list)
    framed: list[tuple[Changed, list[tuple[int, int, int, int]]]] = field(default_factory=list)

    def summary(self) -> str:
        """Return a line with the numbers of views, objects and issues."""
        counts = [amount(sum(f.level == level for f in self.issues), level) for level in LEVELS]
        objects, masks = sum(i != 0 for i in self.coverage.ids), int(self.coverage.usable.sum())
        return (
            f"{self.data}: {amount(len(self.stems), 'view')}, {amount(masks, 'usable mask')}, "
            f"{amount(objects, 'object')}; {', '.join(counts)}."
        )

    @property
    def stops(self) -> bool:
        """Return whether training would stop."""
        return any(issue.level == "error" for issue in self.issues)

    def add(self, found: Sequence[Contradiction], masks: int) -> None:
        """Add contradictions of one kind, except those of objects that most views lack. masks: number of all."""
        absent = {class_id for issue in self.issues if issue.kind == "absent" for class_id in issue.objects}
        added = [one for one in found if one.class_id not in absent]
        self.contradictions += added
        self.issues = ordered([*self.issues, *issues_of(added, self.names, masks)])

    def objects(self) -> list[str]:
        """Return a line for each object: the number of training views that show it, and its share of their pixels."""
        coverage, lines = self.coverage, []
        usable = np.asarray(self.trained) & coverage.usable
        for column, class_id in enumerate(coverage.ids):
            if class_id != BACKGROUND:
                views = usable & (coverage.pixels[:, column] > 0)
                share = percent(coverage.pixels[views, column].sum(), coverage.size[views].sum())
                lines.append(
                    f"{class_id} ({self.names[class_id]}): in {views.sum()} of {usable.sum()} training views with a "
                    f"mask ({percent(views.sum(), usable.sum())}), {share} of their pixels"
                )
        return lines

    def lines(self) -> list[str]:
        """Return the lines of the printed report: objects, issues with their costs, summary."""
        objects = self.objects()
        if len(objects) > MOST_OBJECTS:
            objects[MOST_OBJECTS:] = [f"and {amount(len(objects) - MOST_OBJECTS, 'more object')}"]
        issues = [f"{issue.level}: {issue.message}\n    costs: {issue.cost}" for issue in self.issues]
        return [*objects, *issues, *([self.compared] if self.compared else []), self.summary()]

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        views = [
            {"view": stem, "pixels": {str(i): int(n) for i, n in zip(self.coverage.ids, row, strict=True) if n}}
            for stem, row in zip(self.stems, self.coverage.pixels, strict=True)
        ]
        return {
            "data": str(self.data),
            "classes": {str(i): name for i, name in self.names.items()},
            "objects": self.objects(),
            "issues": [issue.to_json() for issue in self.issues],
            "coverage": views,
            "contradictions": [one.to_json() for one in self.contradictions],
            "areas": [area.to_json() for area in self.areas],
        }


def check(parser: DataOptions, run: Run | None = None) -> Report:
    """Check the masks of a scene; if nothing stops training, also at the depths of a run."""
    report = check_scene(parser)
    if run is not None and not report.stops:
        options = ReprojectionOptions(method="voxel", run_size=True, parser=parser)
        add_areas(report, reproject_run(run, options))
    return report


def check_scene(config: DataOptions) -> Report:
    """Check the masks of the scene that ``config`` names, at the size of the photos.

    Raises ``UserError`` only for bad poses or photos.
    """
    config = replace(config, downscale_factor=1.0)
    scene, views, files = _files(config)
    with progress_bar("Reading masks") as progress:
        coverage = check_files(files, progress)
    names = files.names or {}
    names = {i: names.get(i, "background" if i == 0 else f"class_{i}") for i in coverage.ids}
    report = Report(scene.root, list(files.stems), names, list(files.trained), coverage, list(coverage.issues))
    if len(coverage.ids) > MOST_IDS:
        report.issues.append(
            Issue(
                "note",
                "not compared",
                f"the masks hold {len(coverage.ids)} ids, so views are not compared: more than {MOST_IDS} take too "
                "much memory; remove ids that are in few views.",
                "the check cannot find ids exchanged between views",
            )
        )
    elif coverage.usable.sum() > 3 and len(coverage.ids) > 1:
        features = features_of(scene, views)
        tracks = tracks_of(features, len(coverage.ids))
        if (issue := turned(features, files, coverage)) is not None:
            report.issues.append(issue)
        agreement, seen = agreements(files, coverage, views, points_in_space(scene, views, config), tracks)
        report.issues += views_against_others(agreement, files, coverage, names)
        _add_points(report, files, views, tracks, seen)
    report.issues = ordered(report.issues)
    return report


def _files(config: DataOptions) -> tuple[Dataset, PosedViews, MaskFiles]:
    parser = SceneData(config)
    scene, views = parser.posed_views()
    sizes = [image_size(path) for path in views.images]
    parser.fit_cameras(views, sizes)
    masks, folder = parser.mask_files(scene, views)
    parser.check_folder(folder)
    trained = set(parser.views_of_split(views, "train"))
    parser.views_of_split(views, "val")  # raises if there is none, as training would
    names_file = scene.root / config.classes_path
    names = read_classes(names_file) if names_file.is_file() else scene.class_names
    files = MaskFiles(
        photo_names(views.images),
        sizes,
        masks,
        folder,
        tuple(config.ignore_ids),
        [view in trained for view in range(len(masks))],
        names,
        names_file if names_file.is_file() else scene.class_names_file or names_file,
        views.images,
    )
    return scene, views, files


def _add_points(report: Report, files: MaskFiles, views: PosedViews, tracks: Tracks, seen: Agreement) -> None:
    """Add the contradictions at points that several views saw."""
    report.tracked = len(seen.labels) > 0
    report.compared = (
        f"Views were compared at {len(seen.labels)} points of the COLMAP model, each in the views that saw it."
        if len(seen.labels)
        else "No COLMAP model says which views saw which points, so parts that masks leave out or take in are found "
        "with --load-config only."
    )
    ids = report.coverage.ids
    report.add(settle(seen, report.stems, ids), int(report.coverage.usable.sum()))
    worst = list(dict.fromkeys(report.stems.index(one.view) for one in report.contradictions))[:MOST_PICTURES]
    report.pointed = [pointed(files, views, view, tracks, seen, ids) for view in worst]


def add_areas(report: Report, run: ReprojectedRun) -> None:
    """Add the contradictions between views at the depths of a trained run."""
    ids = sorted(run.classes)
    right, missing, extra = np.zeros((3, len(run.names), len(ids)), np.int64)
    for index, name in enumerate(run.names):
        if (mask := run.given[index]) is None:
            continue
        given, voted = mask.numpy(), run.voted[index].numpy()
        right[index] = np.bincount(given[(given == voted) & (given != IGNORE)], minlength=ids[-1] + 1)[ids]
        for area in contradicted(given, voted, run.confidence[index].numpy() / np.float32(255.0), name):
            missing[index, ids.index(area.voted)] += area.pixels
            extra[index, ids.index(area.given)] += area.pixels
            report.areas.append(area)
    report.areas.sort(key=lambda area: -area.pixels)
    at_depths = contradictions(right, missing, extra, run.names, ids, "pixels")
    report.add(at_depths, sum(mask is not None for mask in run.given.stored))
    for view in list(dict.fromkeys(one.view for one in report.contradictions if one.of == "pixels"))[:MOST_PICTURES]:
        boxes = [area.box for area in report.areas if area.view == view]
        report.framed.append((run.changed(run.names.index(view)), boxes))


def write_report(report: Report, output: Path) -> list[Path]:
    """Write report.json, coverage.png if there are objects, and contradicted.png; return the paths."""
    coverage = report.coverage
    share = coverage.pixels / np.maximum(coverage.size, 1)[:, None]
    written = [output / "report.json"]
    with writing(output):
        output.mkdir(parents=True, exist_ok=True)
        written[0].write_text(json.dumps(report.to_json(), indent=1), "utf8")
        if any(class_id != BACKGROUND for class_id in coverage.ids):
            written.append(output / "coverage.png")
            coverage_picture(written[1], report.stems, coverage.ids, report.names, share, coverage.usable)
    return [*written, *write_contradictions(report, output)]


def write_contradictions(report: Report, output: Path) -> list[Path]:
    """Write the worst views to contradicted.png, if there are any; return its path."""
    picture = output / "contradicted.png"
    if not report.pointed and not report.framed:
        picture.unlink(missing_ok=True)  # it would show former masks
        return []
    contradicted_picture(picture, report.pointed, report.framed)
    return [picture]


def options_beside(run: Run | None, data: Path | None, **given: Any) -> DataOptions:
    """Return the data options of a run, or the default ones without a run, with those ``given`` that are not None.

    data: folder of the scene; that of the run if None.
    """
    config = DataOptions()
    if run is not None:
        config = replace(run.config.data_config.dataparser, data=run.config.data_path)
    if data is not None:
        config = replace(config, data=data)
    return replace(config, **{name: value for name, value in given.items() if value is not None})


def data_options(data: Path, layout: str = "auto", images_path: Path | None = None, **given: Any) -> DataOptions:
    """Return ``options_beside`` of a scene without a run."""
    return options_beside(None, data, layout=layout, images_path=images_path, **given)
