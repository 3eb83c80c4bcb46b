"""Places that cannot be written: full, read-only, not permitted, taken by something else."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mistakes.table import SHORT, TRAINED, Place, mistake

WRITING = {  # commands that write into {out}
    "extract": "extract --load-config {run} --output",
    "export": "export --load-config {run} --all --output",
    "a mesh": "export --load-config {run} --object cup --format glb --resolution 8 --min-views 1 --output",
    "spz": "export --load-config {run} --object cup --format spz --output",
    "render": "render --load-config {run} --object cup --size 16 --frames 2 --output",
    "a picture": "render --load-config {run} --object cup --size 16 --views 1 --format sheet --output",
    "eval": "eval --load-config {run} --json",
    "eval's table": "eval --load-config {run} --csv",
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
    "eval's table": "out.csv",
    "eval's picture": "out.png",
    "doctor": "out.json",
    "sample": "sample",
}


def writing(title: str, prepare: Callable[[Place, Path], Any]) -> Callable[[Place], Any]:
    """A command that writes where it cannot. prepare: is given the folder, which does not exist yet."""

    def make(at: Place):
        from beags_plugin.commands.doctor import diagnosis

        at.patch.setattr(diagnosis, "diagnose", lambda: [])  # of the doctor's own work nothing is asked here
        folder = at.root / "out"
        at.run  # noqa: B018  (made before the disk is full)
        words = WRITING[title].replace("{data}", str(at.data))
        command = at.beags(words, folder / FILES[title] if title in FILES else folder)
        prepare(at, folder)
        return command

    return make


for _title in WRITING:
    mistake("full disk", _title)(writing(_title, lambda at, folder: at.fail_to_write(folder)))
mistake("no permission", "masks make")(writing("masks make", lambda at, folder: at.fail_to_write(folder, errno.EACCES)))
mistake("read-only disk", "extract")(writing("extract", lambda at, folder: at.fail_to_write(folder, errno.EROFS)))
for _title in ("export", "masks reproject"):
    mistake("a file in place of a folder", _title)(writing(_title, lambda at, folder: folder.write_text("x")))


@mistake("a folder in place of a file", "a picture")
def _(at: Place):
    (at.root / "out.png").mkdir()
    return at.beags("render --load-config {run} --size 16 --views 1 --format sheet --output", at.root / "out.png")


@mistake("full disk", "ns-train writes its config")
def _(at: Place):
    command = at.train()
    at.fail_to_write(at.root / TRAINED)
    return command


@mistake("full disk", "ns-train writes its checkpoint")
def _(at: Place):
    from beags_plugin.plugin.training import checkpoints

    command = at.train(*SHORT, preset="beags-tiny")
    save = checkpoints.save_atomically

    def full(content, path):
        at.fail_to_write(at.root / TRAINED, after=1000)
        save(content, path)

    at.patch.setattr(checkpoints, "save_atomically", full)
    return command


@mistake("full disk", "ns-train writes its curves")
def _(at: Place):
    import tempfile

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


@mistake("full disk", "ns-train prepares refinement")
def _(at: Place):
    from beags_plugin.plugin.training import refinement

    command = at.train(*SHORT, preset="beags-tiny")
    save = refinement.save_prepared

    def full(prepared, names, folder):
        at.fail_to_write(at.root / TRAINED / "prepared")
        save(prepared, names, folder)

    at.patch.setattr(refinement, "save_prepared", full)
    return command


@mistake("full disk", "the folder of temporary files")
def _(at: Place):
    import tempfile

    command = at.train(*SHORT)

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    from beags_plugin.system import filed_tensors

    at.patch.setattr(filed_tensors, "write_tensors", full)
    at.patch.setattr(tempfile, "tempdir", str(at.root))
    return command


@mistake("no permission", "ns-train")
def _(at: Place):
    command = at.train()
    at.fail_to_write(at.root / TRAINED, errno.EACCES)
    return command


@mistake("no permission", "a photo")
def _(at: Place):
    import PIL.Image

    opened = PIL.Image.open

    def refusing(path, *rest, **options):
        if str(path).endswith("images/v02.png"):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return opened(path, *rest, **options)

    at.patch.setattr(PIL.Image, "open", refusing)
    return at.train()


@mistake("no permission", "the config of a run")
def _(at: Place):
    read = Path.read_text

    def refusing(path, *rest, **options):
        if path.name == "config.yml":
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return read(path, *rest, **options)

    command = at.beags("extract --load-config {run}")
    at.patch.setattr(Path, "read_text", refusing)
    return command
