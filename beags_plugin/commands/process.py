"""``beags process``: poses of photos or of a video."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from beags_plugin.commands.answers import CONSOLE
from beags_plugin.commands.starting import starting
from beags_plugin.system.output_option import OUTPUT_DIR
from beags_plugin.system.pasted import command
from beags_plugin.system.progress import progress_bar


@dataclass
class Process:
    """Find the poses of photos or of a video, on the CPU, and write a scene that ns-train reads.

    Results are kept in the folder: a second call continues, also with more photos.
    """

    data: Path
    """Folder of photos, or a video."""
    output_dir: Annotated[Path, OUTPUT_DIR]
    """Folder to write: images/, transforms.json, sparse_pc.ply, colmap/sparse/0, poses.json, poses.png."""

    masks: Path | None = None
    """Folder of id images <photo>.png: only the objects' features are used, for turntables, where objects turn and the
    room stands still."""

    ignore_ids: tuple[int, ...] = ()
    """Ids in these images that mean "unlabelled", e.g. 255."""

    def run(self) -> None:
        for line in find_poses(self.data, self.output_dir, starting(self), self.masks, self.ignore_ids):
            CONSOLE.print(line)
        words = ["ns-train", "beags-base", "--data", str(self.output_dir)]
        if self.masks is not None:
            words = ["ns-train", "beags-fast", *words[2:], "--pipeline.datamanager.photos", "objects"]
            options = []
            if self.masks.resolve() != (self.output_dir / "masks").resolve():
                options += ["--masks-path", str(self.masks.absolute())]
            if self.ignore_ids:
                options += ["--ignore-ids", *map(str, self.ignore_ids)]
            words += ["beags-data", *options] if options else []
        CONSOLE.print(f"  {command(words)}")


def find_poses(
    data: Path,
    output: Path,
    start: AbstractContextManager[None],
    masks: Path | None = None,
    ignore_ids: tuple[int, ...] = (),
) -> list[str]:
    """Write the poses of photos or a video, and their picture, into ``output``; return lines that report them.

    start: entered while modules are imported. masks, ignore_ids: see ``Process``. Raises ``UserError`` as
    ``posing.process.process`` does.
    """
    with start:
        import numpy as np

        from beags_plugin.pictures.poses import draw_poses
        from beags_plugin.posing.files import APPLIED, camera_to_world
        from beags_plugin.posing.process import REPORT, process
    report, model = process(data, output, progress_bar, masks, ignore_ids)
    picture = output / "poses.png"
    if not picture.exists() or picture.stat().st_mtime < (output / REPORT).stat().st_mtime:
        images = [model.images[image_id] for image_id in model.reg_image_ids()]
        points = list(model.points3D.values())
        draw_poses(
            picture,
            np.stack([camera_to_world(image) for image in images]),
            np.array([point.xyz for point in points]).reshape(-1, 3) @ APPLIED[:, :3].T,
            np.array([point.color for point in points]).reshape(-1, 3),
            report.summary(),
        )
    return [report.summary(), *report.notes, f"  {picture}"]
