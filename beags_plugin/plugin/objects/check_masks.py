"""``beags masks check``: errors and contradictions in the masks of a scene, found before training on them."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from beags_plugin.data.dataset import Dataset
from beags_plugin.data.files import image_size, photo_names
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.labels.classes import read_classes
from beags_plugin.masks.check.areas import Area, contradicted
from beags_plugin.masks.check.consistency import Agreement, labels_at, ranks_of
from beags_plugin.masks.check.disagreement import views_against_others
from beags_plugin.masks.check.files import FEW_VIEWS, MOST_IDS, Coverage, MaskFiles, check_files
from beags_plugin.masks.check.issues import LEVELS, Issue, ordered, percent
from beags_plugin.pictures.masks import contradictions, coverage_picture
from beags_plugin.plugin.runs.place import open_run
from beags_plugin.plugin.views.cameras import camera_from_nerfstudio
from beags_plugin.plugin.views.dataparser import BeagsDataParser, BeagsDataParserConfig
from beags_plugin.plugin.views.lens import project_through_lens
from beags_plugin.plugin.views.poses import PosedViews
from beags_plugin.plugin.views.seed_points import random_points, starting_points
from beags_plugin.system.errors import UserError, writing
from beags_plugin.system.progress import progress_bar

if TYPE_CHECKING:
    from beags_plugin.plugin.objects.reproject_masks import ReprojectedRun

RANDOM_POINTS = 50_000  # beside the seed points: an object that has none of these has some of them in it
MOST_SEED_POINTS = 100_000
MOST_COUNTS = 30_000_000  # points times classes that are counted at a time
MOST_PICTURES = 6  # views in contradicted.png
MOST_OBJECTS = 40  # that are printed


@dataclass
class Report:
    """The findings.

    names: class id to name. trained: False for held-out views. areas: places where views disagree, with a trained run.
    """

    data: Path
    stems: list[str]
    names: dict[int, str]
    trained: list[bool]
    coverage: Coverage
    issues: list[Issue]
    areas: list[Area] = field(default_factory=list)

    def summary(self) -> str:
        """Return a line with the numbers of views, objects and issues."""
        counts = [f"{sum(f.level == level for f in self.issues)} {level}s" for level in LEVELS]
        objects = sum(i != 0 for i in self.coverage.ids)
        return (
            f"{self.data}: {len(self.stems)} views, {int(self.coverage.usable.sum())} usable masks, {objects} objects; "
            f"{', '.join(counts)}."
        )

    def objects(self) -> list[str]:
        """Return a line for each object: in how many training views it is, and its share of their pixels."""
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
        """Return what people read: the objects, the issues with what they cost, the summary."""
        objects = self.objects()
        if len(objects) > MOST_OBJECTS:
            objects[MOST_OBJECTS:] = [f"and {len(objects) - MOST_OBJECTS} more objects"]
        issues = [f"{issue.level}: {issue.message}\n    costs: {issue.cost}" for issue in self.issues]
        return [*objects, *issues, self.summary()]

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
            "areas": [area.to_json() for area in self.areas],
        }


def check_scene(config: BeagsDataParserConfig, few_views: int = FEW_VIEWS) -> Report:
    """Check the masks of the scene that ``config`` names, at the size of the photographs.

    Raises ``UserError`` only where poses or photos are bad.
    """
    config = replace(config, downscale_factor=1.0)
    if few_views < 1:
        raise UserError(f"min_views is {few_views}: give a number of views, at least 1.")
    scene, views, files = _files(config)
    with progress_bar("Reading masks") as progress:
        coverage = check_files(files, few_views, progress)
    names = files.names or {}
    names = {i: names.get(i, "background" if i == 0 else f"class_{i}") for i in coverage.ids}
    issues = list(coverage.issues)
    if len(coverage.ids) > MOST_IDS:
        issues.append(
            Issue(
                "note",
                "not compared",
                f"the masks hold {len(coverage.ids)} ids, so views are not compared: more than {MOST_IDS} take too "
                "much memory; drop ids that are in few views.",
                "ids exchanged between views are not looked for",
            )
        )
    elif coverage.usable.sum() > 3 and len(coverage.ids) > 1:
        points = _points(scene, views, config)
        issues += views_against_others(_agreement(files, coverage, views, points), files, coverage, names)
    return Report(scene.root, list(files.stems), names, list(files.trained), coverage, ordered(issues))


def agreement_of(config: BeagsDataParserConfig) -> tuple[np.ndarray, int]:
    """Return labels [P, V] of points in space in every view (``consistency.Agreement``) and the number of classes."""
    scene, views, files = _files(config)
    coverage = check_files(files)
    return _agreement(files, coverage, views, _points(scene, views, config)).labels, len(coverage.ids)


def _files(config: BeagsDataParserConfig) -> tuple[Dataset, PosedViews, MaskFiles]:
    parser: BeagsDataParser = config.setup()
    scene, views = parser.posed_views()
    sizes = [image_size(path) for path in views.images]
    parser.fit_cameras(views, sizes)
    masks, folder, kind = parser.mask_files(scene, views)
    trained = set(parser.views_of_split(views, "train"))
    parser.views_of_split(views, "val")  # without which training stops
    names_file = scene.root / config.classes_path
    names = read_classes(names_file) if names_file.is_file() else scene.class_names
    files = MaskFiles(
        photo_names(views.images),
        sizes,
        masks,
        folder,
        kind,
        tuple(config.ignore_ids),
        [view in trained for view in range(len(masks))],
        names,
        names_file if names_file.is_file() else scene.class_names_file or names_file,
    )
    return scene, views, files


def _points(scene: Dataset, views: PosedViews, config: BeagsDataParserConfig) -> np.ndarray:
    """Return [P, 3] float64 in the cameras' world: seed points, and random points where the cameras look."""
    found = starting_points(scene, views, config.num_random_points)
    seeds = found["points3D_xyz"].double().numpy()
    step = -(-len(seeds) // MOST_SEED_POINTS)
    cameras = [camera_from_nerfstudio(views.cameras, index) for index in range(len(views.images))]
    random, _ = random_points(cameras, RANDOM_POINTS)
    return np.concatenate([seeds[::step], random.astype(np.float64)])


def _agreement(files: MaskFiles, coverage: Coverage, views: PosedViews, points: np.ndarray) -> Agreement:
    step = -(-len(points) * len(coverage.ids) // MOST_COUNTS)
    points = points[::step]
    labels = np.full((len(points), len(files.stems)), -1, np.int16)
    with progress_bar("Comparing views") as progress:
        for view in range(len(files.stems)):
            if coverage.usable[view]:
                mask = files.read(view)
                assert mask is not None
                xy, z = project_through_lens(points, views.cameras, view)
                labels[:, view] = labels_at(xy, z, ranks_of(mask, coverage.ids, IGNORE))
            progress(view + 1, len(files.stems))
    return Agreement(labels, len(coverage.ids))


def check_with_run(report: Report, run: ReprojectedRun) -> Report:
    """Return the report with the areas of masks that the other views contradict at the depths of a trained run."""
    areas = [area for index in range(len(run.names)) for area in _areas(run, index)]
    areas.sort(key=lambda area: -area.pixels)
    issues = list(report.issues)
    if areas:
        pixels, views = sum(area.pixels for area in areas), {area.view for area in areas}
        total = sum(mask.pixels for mask in run.given.stored if mask is not None)
        issues.append(
            Issue(
                "warning",
                "contradicted",
                f"{len(areas)} areas in {len(views)} views are contradicted by the other views, the largest: "
                f"{'; '.join(area.describe(run.classes) for area in areas[:3])}: correct these masks of {report.data}, "
                "or leave it to reprojection.",
                f"{pixels} pixels ({percent(pixels, total)} of the masks) go to another class in reprojection; "
                "with --pipeline.model.prepare.reprojection none they pull Gaussians to the wrong class",
                tuple(sorted(views)),
            )
        )
    return replace(report, issues=ordered(issues), areas=areas)


def _areas(run: ReprojectedRun, index: int) -> list[Area]:
    given = run.given[index]
    if given is None:
        return []
    confidence = run.confidence[index].numpy() / np.float32(255.0)
    return contradicted(given.numpy(), run.voted[index].numpy(), confidence, run.names[index])


def write_report(report: Report, output: Path, run: ReprojectedRun | None = None) -> list[Path]:
    """Write report.json, with objects coverage.png, with contradicted areas contradicted.png; return their paths."""
    coverage = report.coverage
    share = coverage.pixels / np.maximum(coverage.size, 1)[:, None]
    written = [output / "report.json"]
    with writing(output):
        output.mkdir(parents=True, exist_ok=True)
        written[0].write_text(json.dumps(report.to_json(), indent=1), "utf8")
        if any(class_id != BACKGROUND for class_id in coverage.ids):
            written.append(output / "coverage.png")
            coverage_picture(written[1], report.stems, coverage.ids, report.names, share, coverage.usable)
    if run is not None and report.areas:
        boxes: dict[str, list[tuple[int, int, int, int]]] = {}
        for area in report.areas:
            boxes.setdefault(area.view, []).append(area.box)
        worst = list(boxes)[:MOST_PICTURES]
        contradictions(
            output / "contradicted.png", [(run.changed(run.names.index(view)), boxes[view]) for view in worst]
        )
        written.append(output / "contradicted.png")
    return written


def options_beside(run: Path | None, data: Path | None, **given: Any) -> BeagsDataParserConfig:
    """Return the data parser's options of a run, or the usual ones without any, replaced by those given that are not
    None.

    run: config.yml. data: folder of the scene, that of the run if None.
    """
    config = BeagsDataParserConfig()
    if run is not None:
        trained = open_run(run, data)
        config = replace(cast("BeagsDataParserConfig", trained.data_config.dataparser), data=trained.data_path)
    if data is not None:
        config = replace(config, data=data)
    return replace(config, **{name: value for name, value in given.items() if value is not None})


def data_options(
    data: Path, layout: str = "auto", images_path: Path | None = None, **given: Any
) -> BeagsDataParserConfig:
    """Return the data parser's options of a scene without a run; given: as of ``options_beside``."""
    return options_beside(None, data, layout=layout, images_path=images_path, **given)
