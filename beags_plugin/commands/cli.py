"""The command line ``beags``: a dataclass per command, whose docstrings are its help.

Other packages add commands by entry points ``beags.commands``, each a dataclass with ``run()``.
"""

from __future__ import annotations

import atexit
import os
import sys
import threading
from collections.abc import Collection
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn, Union, get_args

import tyro
from rich.markup import escape

from beags_plugin.commands.answers import CONSOLE, write_json
from beags_plugin.commands.masks import Masks
from beags_plugin.commands.of_runs import Clean, Eval, Export, Extract, Render
from beags_plugin.commands.process import Process
from beags_plugin.commands.starting import check_arguments, run_config, starting
from beags_plugin.system.errors import UserError, refused, silence_libraries
from beags_plugin.system.output_option import OUTPUT
from beags_plugin.system.registry import Registry

if TYPE_CHECKING:
    from beags_plugin.sample.writer import SampleConfig

COMMANDS = Registry("command", "beags.commands", {})
KNOWN = {
    "bench": "beags bench is a package of its own: in a clone of beags, call pip install ./benchmarks, or make setup.",
}
"""Commands of packages of ours, with the sentence to print if the package is not installed."""


@dataclass
class Demo:
    """Train, extract and measure: on a generated sample, or on a scene, photos or a video of yours.

    Where there are no poses they are computed; where there are no masks, a small network marks what stands out.
    """

    data: Path | None = None
    """Folder of a scene or of photos, or a video; the generated sample if left out."""
    output: Annotated[Path | None, OUTPUT] = None
    """Folder for everything; outputs/demo, or outputs/<name of the data>, if left out."""
    preset: str | None = None
    """Preset of method_configs/ to train; if left out, beags-tiny for the sample and beags-fast for data."""
    downscale: float | None = None
    """Divide the image size by this; chosen for a quick run if left out (a folder of your own only)."""
    seed: int = 0
    """Seed of the generated sample."""
    fresh: bool = False
    """Train again even if the same demo has been trained before."""
    strict: bool = False
    """Stop where masks contradict one another, before anything is trained; at the end, fail if it is not sure."""
    pick: bool = False
    """Click on the objects in the viewer, which opens once the base is trained; the demo continues once they are saved.
    With --fresh they are picked again, on the same base."""
    objects: int = 1
    """Number of salient things to separate, if they do not touch; with --pick, of objects to click on and name."""
    mask_source: str | None = None
    """Source of masks where there are none: salient, rembg, sam2, or your own (docs/masks.md); salient if left out."""
    mask_options: tuple[str, ...] = ()
    """Options of the source, as key=value, e.g. model=isnet-general-use."""

    def run(self) -> None:
        with starting(self, nerfstudio=True):
            from beags_plugin.commands.demo import run_demo
        run_demo(
            self.data, self.output, self.preset, self.downscale, self.seed, self.fresh, self.strict, self.pick,
            self.objects, self.mask_source, self.mask_options,
        )  # fmt: skip


@dataclass
class Sample:
    """Generate a scene with exact ground truth: photos, damaged masks, silhouettes, depth."""

    output: Annotated[Path, OUTPUT] = Path("outputs/sample")
    """Folder to write."""
    seed: int = 0
    """Another seed gives another arrangement."""
    width: int = 256
    """Pixels."""
    height: int = 192
    """Pixels."""
    degradation: str = "mild"
    """How masks are damaged: none, mild or strong."""
    views: int = 60
    """Views to train on; 12 more are held out."""
    family: str = "tabletop"
    """tabletop: plain solids that touch. desk: textured objects that touch in a furnished room. Both are seen from all
    sides. benchmarks/ adds turntable (the tabletop's solids turn while the room stands still) and room (textured
    objects that lean on and stand in one another, seen from one side)."""

    def config(self) -> SampleConfig:
        """Return the config of the sample to write."""
        from beags_plugin.sample.writer import SampleConfig

        return SampleConfig(
            self.seed, self.width, self.height, self.views, degradation=self.degradation, family=self.family
        )

    def run(self) -> None:
        with starting(self):
            from beags_plugin.sample.writer import make_sample

            config = self.config()
        make_sample(self.output, config)
        CONSOLE.print(f"sample: {self.output}")


@dataclass
class Resume:
    """Continue an interrupted training in its own folder; the result is the same as without the interruption."""

    run_folder: tyro.conf.Positional[Path]
    """Folder of the run (or its config.yml)."""

    device: Literal["cpu", "cuda"] | None = None
    """Continue on this device instead of the first one; the result is then no longer bit for bit the same."""

    data: Path | None = None
    """Folder of the photos, if not where the run was trained on them."""

    check_memory: bool = True
    """Refuse to begin if hardly any memory or disk is free; save and stop when memory runs out."""

    def run(self) -> None:
        with starting(self, nerfstudio=True):
            from beags_plugin.plugin.launch import resume
        try:
            resume(self.run_folder, self.device, self.check_memory, self.data)
        except KeyboardInterrupt:
            sys.exit(130)


@dataclass
class View:
    """Look at a run in the browser, pick and export objects; safe for runs of other people.

    Nothing that its files name is executed, and only this computer is served. Ctrl-C ends it.
    """

    run_folder: tyro.conf.Positional[Path]
    """Folder of the run (or its config.yml)."""
    port: int | None = None
    """Port of this computer; the first free one from 7007 on if left out."""
    data: Path | None = None
    """Folder of the photos, if not where the run was trained on them."""
    save_to: Path | None = None
    """Folder for Save as masks, which then ends the viewer: how beags demo --pick asks for objects."""
    expect: tuple[str, ...] = ("object 1",)
    """With --save-to: the objects to be picked, under these names if they get no others."""

    def run(self) -> None:
        with starting(self, nerfstudio=True):
            from beags_plugin.plugin.viewer.errand import Errand
            from beags_plugin.plugin.viewer.serve import serve
        errand = None if self.save_to is None else Errand(self.save_to.absolute(), self.expect)
        serve(run_config(self.run_folder), self.data, self.port, errand)


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


Command = Demo | Process | Resume | Sample | Masks | View | Extract | Export | Clean | Render | Eval | Doctor


def all_commands(arguments: list[str] | None) -> Any:
    """Return the union of our commands and, unless the arguments name one of ours, of other packages' commands."""
    ours = [command.__name__.lower() for command in get_args(Command)]
    first = next(iter(sys.argv[1:] if arguments is None else arguments), "")
    return Command if first in ours else Union[(Command, *other_commands(first, ours))]  # noqa: UP007  (of a tuple)


def other_commands(first: str, taken: Collection[str]) -> list[Any]:
    """Return commands of other packages, for tyro: only the one named ``first`` if there is one, else all.

    taken: names of our own. Raises ``UserError`` for a name that is taken, a command that fails to load, and one of
    ``KNOWN`` that is not installed.
    """
    names = COMMANDS.names()
    if twice := sorted({*names} & {*taken}):
        raise UserError(
            f"another package adds a command {twice[0]!r}, which beags has already: uninstall that package."
        )
    if first in KNOWN and first not in names:
        raise UserError(KNOWN[first])
    chosen = [first] if first in names else names
    return [Annotated[COMMANDS.get(name), tyro.conf.subcommand(name)] for name in chosen]


def exit_with(error: UserError) -> NoReturn:
    """Print a user error, unless the trainer has printed it, and end with exit code 2."""
    if not error.reported:
        CONSOLE.print(f"[bold red]beags:[/bold red] {escape(str(error))}", markup=True)
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
        CONSOLE.print("[bold red]beags:[/bold red] interrupted.", markup=True)
        sys.exit(130)
    if arguments is None:  # This process runs nothing else.
        end_process()


def end_process() -> None:
    """End the process in success without the destructors of torch's CUDA libraries, if it only read finished runs.

    They take half a second, and read 120 MB of these libraries. Threads are waited for, and exit functions called, as
    always. A process with nerfstudio, which trains or serves the viewer, ends as Python ends.
    """
    if "torch" not in sys.modules or "nerfstudio" in sys.modules:
        return
    threading._shutdown()  # pyright: ignore[reportAttributeAccessIssue]  (as Python itself does first)
    atexit._run_exitfuncs()
    try:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None and not stream.closed:  # None: the process was started without
                stream.flush()
    except OSError:  # Python reports it as it ends.
        return
    os._exit(0)


if __name__ == "__main__":
    main()
