"""Commands about scenes that are trained: extract, export, clean, render and eval."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from beags_plugin.commands.answers import CONSOLE, write_json
from beags_plugin.commands.starting import starting
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.export.pose_options import PoseOptions
from beags_plugin.pictures.options import RenderOptions
from beags_plugin.surfaces.mesh_options import MeshOptions
from beags_plugin.system.output_option import OUTPUT
from beags_plugin.system.pasted import quoted
from beags_plugin.system.progress import progress_bar


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
    """Also keep Gaussians that do not belong to it: spikes outside its masks, loose parts that no mask supports."""
    data: Path | None = None
    """Folder of the photos, if they were moved; which Gaussians belong to an object is decided in its views."""

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
            dropped = "" if done.left_out is None else f"; {done.left_out}"
            CONSOLE.print(f"{done.name}: {done.gaussians} Gaussians{dropped}\n  {done.ply}")
            CONSOLE.print(f"  beags view {quoted(done.config.parent)}")
        for sentence in sentences:
            CONSOLE.print(sentence)


@dataclass(frozen=True)
class SplatOptions:
    """Options of splat files."""

    spz_version: Literal[3, 4] = 3
    """Version of .spz: 3, which most readers support, or 4, which is slightly smaller."""
    surflets: bool = False
    """USD: write discs as surflets, which are invisible from the side, instead of thin 3D Gaussians, which all programs
    with splats can render."""
    usd_up: Literal["y", "z"] = "y"
    """USD of splats: the axis that is up."""

    def of_formats(self, mesh: MeshOptions) -> dict[str, dict[str, Any]]:
        """Return the options of exporters by their names; mesh: options of colliders."""
        usd = {"kernel": "surflet" if self.surflets else "ellipsoid", "up_axis": self.usd_up, "mesh": mesh}
        return {"spz": {"version": self.spz_version}, "usdz-splats": usd, "usda-splats": usd}


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
    """Folder of the photos, if they were moved. Meshes need it, and the choice of what belongs to an object."""
    keep_all: bool = False
    """Also keep Gaussians that do not belong to it: spikes outside its masks, loose parts that no mask supports."""
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
            CONSOLE.print(str(one))
            for file in one.files:
                CONSOLE.print(f"  {file}")
        for sentence in sentences:
            CONSOLE.print(sentence)


@dataclass
class Clean:
    """Refine a splat scene that another program trained, with its photos, and write it back in its own format.

    Poses and masks are made where there are none, as by the demo. The report says what changed.
    """

    scene: tyro.conf.Positional[Path]
    """The splat file: .ply, .spz, .sog, .splat, .glb, .usdz and others (docs/export.md), or a run of splatfacto."""
    data: Path
    """Folder of the photos, of id masks, and of poses in the frame of the scene."""
    object: tuple[str, ...] = ()
    """Names of objects that get a file of their own too."""
    output: Annotated[Path | None, OUTPUT] = None
    """Folder for the files, the report and the run; outputs/<scene>_cleaned if left out."""
    polish: int = 300
    """Base steps before refinement; they repair the loss from flattening a scene of 3D Gaussians."""
    steps: int | None = None
    """Steps of refinement; those of beags-refine if left out."""
    overwrite: bool = False
    """Replace a scene that was cleaned into the same folder before."""

    def run(self) -> None:
        with starting(self, nerfstudio=True):
            from beags_plugin.commands.clean import clean_scene
        clean_scene(self.scene, self.data, self.object, self.output, self.polish, self.steps, self.overwrite)


@dataclass
class Render:
    """Render objects: a turntable, a contact sheet, assignment alone beside the refined object, or a camera path."""

    load_config: Path
    """A trained run: its folder, or config.yml in it."""
    object: tuple[str, ...] = ()
    """Names of the objects; all but the background if left out."""
    format: str = "video"
    """video (.mp4 or .gif), sheet (.png or .jpg), or before-after (any of these, by the name of the file)."""
    output: Annotated[Path | None, OUTPUT] = None
    """The file; in renders/ beside config.yml if left out."""
    data: Path | None = None
    """Folder of the photos, if they were moved; their cameras tell which way is up."""
    pictures: tyro.conf.OmitArgPrefixes[RenderOptions] = RenderOptions()

    def run(self) -> None:
        with starting(self):
            from beags_plugin.objects.render import render_run
        with progress_bar("rendering") as progress:
            path = render_run(
                self.load_config, self.object, self.format, self.output, self.pictures, progress, self.data
            )
        CONSOLE.print(f"{self.format}: {path}")


@dataclass
class Eval:
    """Score a run on its held-out views: masks per object, PSNR and SSIM, before and after refinement."""

    load_config: Path
    """A trained run: its folder, or config.yml in it."""
    json: Path | None = None
    """File for all figures, down to single masks and views."""
    picture: Path | None = None
    """File for a picture of the worst masks: right, missed and wrong pixels, before and after."""
    worst: int = 6
    """Number of masks of each kind in the picture."""
    data: Path | None = None
    """Folder of the photos, if not where the run was trained on them."""
    protocol: tyro.conf.OmitArgPrefixes[Protocol] = Protocol()

    def run(self) -> None:
        with starting(self):
            from beags_plugin.commands.evaluate import Outputs, run_evaluation
        outputs = Outputs(self.json, self.picture, self.worst)
        run_evaluation(self.load_config, self.protocol, outputs, self.data)
