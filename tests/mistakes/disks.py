"""Places that cannot be written: full, read-only, not permitted, taken by something else."""

from __future__ import annotations

import errno
import tempfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import PIL.Image

from mistakes.table import SHORT, TRAINED, Place, mistake, mistakes

WRITING = {  # commands that write into {out}
    "extract": "extract --load-config {run} --output",
    "export": "export --load-config {run} --all --output",
    "a mesh": "export --load-config {run} --object cup --format glb --resolution 8 --min-views 1 --output",
    "spz": "export --load-config {run} --object cup --format spz --output",
    "render": "render --load-config {run} --object cup --size 16 --frames 2 --output",
    "a picture": "render --load-config {run} --object cup --size 16 --views 1 --format sheet --output",
    "eval": "eval --load-config {run} --json",
    "eval's picture": "eval --load-config {run} --picture",
    "masks check": "masks check --data {data} --output",
    "masks make": "masks make --data {data} --source id-images --output",
    "masks reproject": "masks reproject --load-config {run} --output",
    "sample": "sample --width 16 --height 16 --views 2 --output",
    "demo": "demo --output",
    "bench": "bench ablation --output",
    "doctor": "doctor --json",
}
FILES = {
    "render": "out.gif",
    "a picture": "out.png",
    "eval": "out.json",
    "eval's picture": "out.png",
    "doctor": "out.json",
    "sample": "sample",
}


def writing(title: str, prepare: Callable[[Place, Path], Any]) -> Callable[[Place], Any]:
    """Return a command that writes where it cannot. prepare: receives the folder, which does not exist yet."""

    def make(at: Place):
        from beags_plugin.commands.doctor import diagnosis

        at.patch.setattr(diagnosis, "diagnose", lambda: [])  # the doctor's own work is beside the point
        folder = at.root / "out"
        at.run  # noqa: B018  (made before the disk is full)
        command = at.beags(WRITING[title], folder / FILES[title] if title in FILES else folder)
        prepare(at, folder)
        return command

    return make


for _title in WRITING:
    mistake("full disk", _title)(writing(_title, lambda at, folder: at.fail_to_write(folder)))
mistake("no permission", "masks make")(writing("masks make", lambda at, folder: at.fail_to_write(folder, errno.EACCES)))
mistake("read-only disk", "extract")(writing("extract", lambda at, folder: at.fail_to_write(folder, errno.EROFS)))
for _title in ("export", "masks reproject"):
    mistake("a file in place of a folder", _title)(writing(_title, lambda at, folder: folder.write_text("x")))


mistake("a folder in place of a file", "a picture")(
    writing("a picture", lambda at, folder: (folder / "out.png").mkdir(parents=True))
)


def training(code: int) -> Callable[[Place], Any]:
    def make(at: Place):
        command = at.train()
        at.fail_to_write(at.root / TRAINED, code)
        return command

    return make


def filling(module: str, function: str, folder: str, after: int = 0, **settings: Any) -> Callable[[Place], Any]:
    """Return a training whose disk is full below ``folder`` from a function of the program on."""

    def make(at: Place):
        command = at.train(*SHORT, preset="beags-tiny", **settings)
        owner = import_module(f"beags_plugin.plugin.training.{module}")
        save = getattr(owner, function)

        def full(*arguments):
            at.fail_to_write(at.root / folder, after=after)
            return save(*arguments)

        at.patch.setattr(owner, function, full)
        return command

    return make


mistakes(
    "full disk",
    {
        "ns-train writes its config": training(errno.ENOSPC),
        "ns-train writes its checkpoint": filling("checkpoints", "save_atomically", TRAINED, after=1000),
        "ns-train prepares refinement": filling("refinement", "save_prepared", f"{TRAINED}/prepared"),
    },
)


@mistake("full disk", "ns-train writes its first checkpoint, and wandb keeps the curves")
def _(at: Place):
    """Its client has begun a folder of the run, and prints when it ends."""
    at.patch.setenv("WANDB_MODE", "offline")
    at.patch.setenv("WANDB_SILENT", "true")
    return filling("checkpoints", "save_atomically", TRAINED, after=1000, vis="wandb")(at)


mistake("no permission", "ns-train")(training(errno.EACCES))


@mistake("read-only disk", "ns-train")
def _(at: Place):
    at.fail_to_write(at.root / "out", errno.EROFS)
    return at.train(run_dir=None, output_dir=at.root / "out", timestamp="now")


@mistake("full disk", "ns-train writes its curves")
def _(at: Place):
    from tensorboard.summary.writer.record_writer import RecordWriter

    at.patch.setattr(tempfile, "tempdir", str(at.root))
    command = at.train(*SHORT, preset="beags-tiny")
    write, left = RecordWriter.write, [10]  # events that the disk still takes

    def full(self, event):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(self, event)

    at.patch.setattr(RecordWriter, "write", full)
    return command


@mistake("full disk", "the folder of temporary files")
def _(at: Place):
    command = at.train(*SHORT)

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    from beags_plugin.system import filed_tensors

    at.patch.setattr(filed_tensors, "write_tensors", full)
    at.patch.setattr(tempfile, "tempdir", str(at.root))
    return command


def refusing(opened: Callable[..., Any], ending: str) -> Callable[..., Any]:
    """Return a function that opens files, but none whose path ends so."""

    def opening(path, *rest, **options):
        if str(path).endswith(ending):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return opened(path, *rest, **options)

    return opening


@mistake("no permission", "a photo")
def _(at: Place):
    at.patch.setattr(PIL.Image, "open", refusing(PIL.Image.open, "images/v02.png"))
    return at.train()


@mistake("no permission", "the config of a run")
def _(at: Place):
    command = at.beags("extract --load-config {run}")
    at.patch.setattr(Path, "read_text", refusing(Path.read_text, "config.yml"))
    return command
