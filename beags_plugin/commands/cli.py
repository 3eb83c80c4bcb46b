"""The command line ``beags``: one dataclass for each command, whose docstrings are the help, and how errors end."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, Union, get_args

import tyro
from rich.console import Console
from rich.markup import escape

from beags_plugin.commands.masks import Masks
from beags_plugin.commands.more import more_commands
from beags_plugin.commands.process import Process
from beags_plugin.commands.starting import check_arguments, starting
from beags_plugin.commands.view import View
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.export.pose_options import PoseOptions
from beags_plugin.export.splat_options import SplatOptions
from beags_plugin.pictures.options import RenderOptions
from beags_plugin.surfaces.mesh_options import MeshOptions
from beags_plugin.system.errors import UserError, refused, silence_libraries
from beags_plugin.system.output_option import OUTPUT
from beags_plugin.system.pasted import quoted
from beags_plugin.system.progress import progress_bar
from beags_plugin.system.whole_files import write_text_atomically

CONSOLE = Console(soft_wrap=True, highlight=False)


@dataclass
class Demo:
    """Train, extract and measure: on a generated sample, or on a scene, photos or a video of yours.

    Where there are no poses they are computed; where there are no masks, a small network marks what stands out.
    """

    data: Path | None = None
    """Folder of a scene or of photos, or a video; the generated sample if left out."""
    output: Annotated[Path | None, OUTPUT] = None
    """Where everything goes; outputs/demo, or outputs/<name of the data>."""
    preset: str | None = None
    """What to train with: a preset of method_configs/; if left out, beags-tiny for the sample, beags-fast for data."""
    downscale: float | None = None
    """Divide the image size by this; chosen for a quick run if left out (a folder of your own only)."""
    seed: int = 0
    """Seed of the generated sample."""
    fresh: bool = False
    """Train again even if the same demo has been trained before."""
    strict: bool = False
    """Stop where masks contradict one another, before anything is trained."""
    pick: bool = False
    """Click on the objects in the viewer, which opens when the base is trained; the demo goes on once they are saved.
    With --fresh they are picked again, on the same base."""
    objects: int = 1
    """How many things that stand out to tell apart, where they do not touch; with --pick, to click on and name."""
    mask_source: str | None = None
    """What makes masks where there are none: salient, rembg, sam2, or your own (docs/masks.md); salient if left out."""
    mask_options: tuple[str, ...] = ()
    """Of the source, as key=value, e.g. model=isnet-general-use."""

    def run(self) -> None:
        with starting(self):
            from beags_plugin.commands.demo import run_demo
        run_demo(
            self.data, self.output, self.preset, self.downscale, self.seed, self.fresh, self.strict, self.pick,
            self.objects, self.mask_source, self.mask_options,
        )  # fmt: skip


@dataclass
class Resume:
    """Continue an interrupted training in its own folder; it ends as it would have without the interruption."""

    run_folder: tyro.conf.Positional[Path]
    """Folder of the run (or its config.yml)."""

    device: Literal["cpu", "cuda"] | None = None
    """Continue on this device instead of where it was begun; the result is then not the same in every bit."""

    data: Path | None = None
    """Folder of the photos, if not where the run was trained on them."""

    check_memory: bool = True
    """Do not begin where hardly any memory or disk is free; save and stop when memory runs out."""

    def run(self) -> None:
        with starting(self):
            from beags_plugin.plugin.launch import resume
        try:
            resume(self.run_folder, self.device, self.check_memory, self.data)
        except KeyboardInterrupt:
            sys.exit(130)


@dataclass
class Sample:
    """Generate a scene with exact ground truth: photos, damaged masks, silhouettes, depth, objects removed."""

    output: Annotated[Path, OUTPUT] = Path("outputs/sample")
    """Folder to write."""
    seed: int = 0
    """Another seed gives another arrangement."""
    width: int = 256
    """Pixels."""
    height: int = 192
    """Pixels."""
    degradation: str = "mild"
    """How masks are damaged: none, mild or strong, or any degree from 0 on (1 is mild, 2 strong)."""
    views: int = 60
    """Views to train on; 12 more are held out."""
    family: str = "tabletop"
    """tabletop: plain solids that touch, seen from all sides. turntable: the same, but they turn and the room stands.
    room: a furnished room with textured objects that lean on and stand in one another, seen from one side. desk: such
    objects put close together, seen from all sides."""
    exposure: float = 0.0
    """The largest difference of a photo's exposure from the mean, in stops (EV), at most 6."""
    white_balance: float = 0.0
    """The largest difference of a photo's red from the mean, and of its blue the other way, in stops, at most 6."""
    moved: int = 0
    """Views to train on that show something of the background which stands elsewhere in each, and in no other view."""
    shared_damage: float = 0.0
    """Share of the masks to train on, 0 to 1, in which half of the objects take in what they stand on, or lack a foot,
    alike in all of them."""

    def run(self) -> None:
        with starting(self):
            from beags_plugin.sample.writer import make_sample
        make_sample(
            self.output, self.seed, self.width, self.height, self.degradation, self.views, family=self.family,
            exposure=self.exposure, white_balance=self.white_balance, moved=self.moved,
            shared_damage=self.shared_damage,
        )  # fmt: skip
        CONSOLE.print(f"sample: {self.output}", markup=False)


@dataclass
class Extract:
    """Write a run folder and a .ply per object; ns-viewer, ns-render and ns-export work on each run."""

    load_config: Path
    """A trained run: its folder, or config.yml in it."""
    object: tuple[str, ...] = ()
    """Names of the objects; all but the background if left out."""
    remove: bool = False
    """Keep everything but the object."""
    output: Annotated[Path | None, OUTPUT] = None
    """Folder for the runs; extracted/ beside config.yml if left out."""
    json: Path | None = None
    """File that lists what was written."""
    keep_all: bool = False
    """Also keep Gaussians that do not belong: spikes outside the object's masks, loose parts that no mask supports."""
    data: Path | None = None
    """Folder of the photos, if not where the run was trained on them; its cameras tell what belongs."""

    def run(self) -> None:
        with starting(self):
            from beags_plugin.objects.extract import extract_objects
        sentences: list[str] = []
        with progress_bar("extracting") as progress:
            extracted = extract_objects(
                self.load_config, self.object, self.remove, self.output, progress, keep_all=self.keep_all,
                data=self.data, say=sentences.append,
            )  # fmt: skip
        write_json(self.json, [asdict(done) for done in extracted])
        for done in extracted:
            CONSOLE.print(
                f"{done.name}: {counted_gaussians(done.gaussians, done.left_out)}\n  {done.ply}\n"
                f"  beags view {quoted(done.config.parent)}",
                markup=False,
            )
        for sentence in sentences:
            CONSOLE.print(sentence, markup=False)


@dataclass
class Export:
    """Write objects as files for other programs, in the frame of the input poses or centred on each object."""

    load_config: Path
    """A trained run: its folder, or config.yml in it."""
    object: tuple[str, ...] = ()
    """Names of the objects."""
    all: bool = False
    """Every object, the emptied background, and a manifest.json."""
    whole: bool = False
    """The whole scene in one file; without --object and --all it needs no classes."""
    format: tuple[str, ...] = ("ply",)
    """ply (viewers of 3D Gaussians), ply-2dgs (the official 2DGS code), spz, compressed-ply, sog, splat (all small),
    gltf-splats, usdz-splats, usda-splats, gltf-both (splats and mesh), html (a page to send), glb, usdz, obj (meshes),
    stl, 3mf (to print), or your own."""
    frame: str = "world"
    """world, that of the input poses; or object, the same with the middle of the object's box as origin."""
    output: Annotated[Path | None, OUTPUT] = None
    """Folder for the files; exports/ beside config.yml if left out."""
    json: Path | None = None
    """File that lists what was written."""
    data: Path | None = None
    """Folder of the photos, if not where the run was trained on them. Meshes need it; its cameras tell what belongs."""
    keep_all: bool = False
    """Also keep Gaussians that do not belong: spikes outside an object's masks, loose parts that no mask supports."""
    close: bool = False
    """Close objects where no photo shows them, such as underneath, with Gaussians or triangles that a .ply and a .glb
    mark as invented; .stl and .3mf are always closed."""
    pose: tyro.conf.OmitArgPrefixes[PoseOptions] = PoseOptions()
    mesh: tyro.conf.OmitArgPrefixes[MeshOptions] = MeshOptions()
    splats: tyro.conf.OmitArgPrefixes[SplatOptions] = SplatOptions()

    def run(self) -> None:
        with starting(self):
            from beags_plugin.objects.export import export_run
        options = {name: asdict(self.mesh) for name in ("glb", "gltf-both", "usdz", "obj", "stl", "3mf")}
        options |= self.splats.of_formats(self.mesh)
        sentences: list[str] = []
        with progress_bar("exporting") as progress:
            exported = export_run(
                self.load_config, self.object, self.all, self.format, self.frame, self.output, options, progress,
                whole=self.whole, data=self.data, keep_all=self.keep_all, pose=self.pose,
                closing=self.mesh if self.close else None, say=sentences.append,
            )  # fmt: skip
        write_json(self.json, [asdict(one) for one in exported])
        for one in exported:
            CONSOLE.print(str(one), markup=False)
            for file in one.files:
                CONSOLE.print(f"  {file}", markup=False)
        for sentence in sentences:
            CONSOLE.print(sentence, markup=False)


@dataclass
class Clean:
    """Refine a splat scene that another program trained, with its photos, and write it back in its own format.

    Poses and masks are made where there are none, as by the demo. The report says what changed.
    """

    scene: tyro.conf.Positional[Path]
    """The splat file: .ply, .spz, .sog, .splat, .glb, .usdz and others (docs/export.md), or a run of splatfacto."""
    data: Path
    """Folder of the photos, with the poses in whose world the scene lies, and id masks."""
    object: tuple[str, ...] = ()
    """Names of objects that get a file of their own too."""
    output: Annotated[Path | None, OUTPUT] = None
    """Folder for the files, the report and the run; outputs/<scene>_cleaned if left out."""
    polish: int = 300
    """Base steps before refinement that repair what flattening costs a scene of 3D Gaussians."""
    steps: int | None = None
    """Steps of refinement; those of beags-refine if left out."""
    overwrite: bool = False
    """Replace a scene that was cleaned into the same folder before."""

    def run(self) -> None:
        with starting(self):
            from beags_plugin.commands.clean import clean_scene
        clean_scene(self.scene, self.data, self.object, self.output, self.polish, self.steps, self.overwrite)


@dataclass
class Render:
    """Render objects: a turntable, a contact sheet, assignment alone beside the refined object, or a camera path.

    Or, with --underlay, each alone in every held-out view, to draw its silhouette over.
    """

    load_config: Path
    """A trained run: its folder, or config.yml in it."""
    object: tuple[str, ...] = ()
    """Names of the objects; all but the background if left out."""
    format: str = "video"
    """video (.mp4 or .gif), sheet (.png or .jpg), or before-after (any of these, by the name of the file)."""
    underlay: bool = False
    """Write <object>/<photo>.png: each object alone over the faded photo, in every held-out view, as large as the
    photo. A silhouette drawn over it, white on black, is read by beags eval (docs/evaluation.md)."""
    output: Annotated[Path | None, OUTPUT] = None
    """The file (with --underlay the folder); in renders/ beside config.yml if left out."""
    data: Path | None = None
    """Folder of the photos, whose cameras say what is up, if not where the run was trained on them."""
    pictures: tyro.conf.OmitArgPrefixes[RenderOptions] = RenderOptions()

    def run(self) -> None:
        if self.underlay:
            self._underlay()
            return
        with starting(self):
            from beags_plugin.objects.render import render_run
        with progress_bar("rendering") as progress:
            path = render_run(
                self.load_config, self.object, self.format, self.output, self.pictures, progress, self.data
            )
        CONSOLE.print(f"{self.format}: {path}", markup=False)

    def _underlay(self) -> None:
        if self.format != "video" or self.pictures != RenderOptions():
            raise UserError(
                "an underlay has the cameras and sizes of the held-out photos: give --underlay no other option "
                "than --load-config, --object, --output and --data."
            )
        with starting(self):
            from beags_plugin.objects.underlay import write_underlays
        with progress_bar("rendering") as progress:
            made = write_underlays(self.load_config, self.object, self.output, progress, self.data)
        CONSOLE.print(
            f"underlay: {made.count} pictures in {made.folder}\n  Fill each object white on a black layer over them, "
            f"parts that others hide too; save it as\n  {made.silhouettes}/<object>/<photo>.png; beags eval reads it.",
            markup=False,
        )


@dataclass
class Eval:
    """Score runs on their held-out views: masks per object, PSNR and SSIM, before and after refinement.

    Several runs are scenes of one data set: a table per scene, and their mean.
    """

    load_config: tuple[Path, ...]
    """One trained run or more: folders, or config.yml in them."""
    data_set_name: str = "mean"
    """What the mean of several runs is called."""
    json: Path | None = None
    """File for all figures, down to single masks and views."""
    csv: Path | None = None
    """File for the figures of objects and scenes as a table."""
    picture: Path | None = None
    """File for a picture of the worst masks: what is right, missed and wrong, before and after."""
    worst: int = 6
    """How many masks of each kind the picture shows."""
    data: Path | None = None
    """Folder of the photos, if not where the run was trained on them."""
    protocol: tyro.conf.OmitArgPrefixes[Protocol] = Protocol()

    def run(self) -> None:
        with starting(self):
            from beags_plugin.commands.evaluate import Outputs, run_evaluation
        outputs = Outputs(self.json, self.csv, self.picture, self.worst)
        run_evaluation(self.load_config, self.data_set_name, self.protocol, outputs, self.data)


@dataclass
class Doctor:
    """Report what this installation can do, what is missing, and the one command that repairs each.

    With --data: whether the scene can be read too, and how much memory and disk are free to train on it.
    """

    data: Path | None = None
    """Folder of a scene (or a transforms .json)."""

    json: Path | None = None
    """File for the report."""

    def run(self) -> None:
        from beags_plugin.commands.doctor.check import print_check
        from beags_plugin.commands.doctor.diagnosis import checks_of_data, diagnose

        check_arguments(self)
        checks = []
        for check in chain(diagnose(), checks_of_data(self.data)):
            print_check(check)
            checks.append(check)
        write_json(self.json, [asdict(check) for check in checks])


def counted_gaussians(count: int, left_out: object) -> str:
    """Return a phrase on an object's Gaussians. left_out: those dropped, or None if nothing was looked for."""
    return f"{count} Gaussians" if left_out is None else f"{count} Gaussians; {left_out}"


def write_json(path: Path | None, content: object) -> None:
    """Write ``content`` as JSON, paths as text, unless ``path`` is None; raises ``UserError`` if that fails."""
    if path is not None:
        write_text_atomically(json.dumps(content, indent=2, default=str) + "\n", path)


Command = Demo | Process | Resume | Sample | Masks | View | Extract | Export | Clean | Render | Eval | Doctor


def all_commands(arguments: list[str] | None) -> Any:
    """Return the union of our commands and, unless the arguments name one of ours, of other packages' commands."""
    ours = [command.__name__.lower() for command in get_args(Command)]
    first = next(iter(sys.argv[1:] if arguments is None else arguments), "")
    return Command if first in ours else Union[(Command, *more_commands(first, ours))]  # noqa: UP007  (of a tuple)


def exit_with(error: UserError) -> NoReturn:
    """Print a user error, unless the trainer has printed it, and end with exit code 2."""
    if not error.reported:
        CONSOLE.print(f"[bold red]beags:[/bold red] {escape(str(error))}")
    sys.exit(2)


def main(arguments: list[str] | None = None) -> None:
    """Run the command ``beags``; a user error prints one sentence and ends with exit code 2."""
    config = (tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)
    description = "BEA-GS: clean objects out of Gaussian-splat scenes."
    silence_libraries()
    try:
        command = tyro.cli(all_commands(arguments), args=arguments, description=description, config=config)
        command.run()
    except UserError as error:
        exit_with(error)
    except OSError as error:
        if (described := refused(error)) is None:
            raise
        exit_with(described)
    except KeyboardInterrupt:
        CONSOLE.print("[bold red]beags:[/bold red] interrupted.")
        sys.exit(130)


if __name__ == "__main__":
    main()
