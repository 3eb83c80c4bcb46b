"""``beags process``: poses of photos or of a video."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from beags_plugin.commands.answers import CONSOLE
from beags_plugin.commands.starting import starting
from beags_plugin.system.output_option import OUTPUT_DIR
from beags_plugin.system.pasted import command
from beags_plugin.system.progress import progress_bar
from beags_plugin.system.whole_files import write_whole

if TYPE_CHECKING:
    import numpy as np

_SHOWN = 20_000  # Points that are drawn.


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


def draw_poses(path: Path, poses: np.ndarray, points: np.ndarray, colors: np.ndarray, title: str) -> None:
    """Write a .png of cameras [V, 4, 4], which look along -z, and points [P, 3] with colours [P, 3] uint8.

    Up is the mean of the cameras' up axes; points far outside of the cameras' surroundings are cut off.
    """
    import numpy as np
    from matplotlib.figure import Figure

    up = poses[:, :3, 1].mean(0)
    up /= np.linalg.norm(up) or 1.0
    side = np.linalg.svd(np.eye(3) - np.outer(up, up))[0][:, :2]
    axes = np.stack([side[:, 0], side[:, 1], up], axis=1)
    centers, looks = poses[:, :3, 3] @ axes, -poses[:, :3, 2] @ axes
    chosen = np.random.default_rng(0).permutation(len(points))[:_SHOWN]
    points, colors = points[chosen] @ axes, colors[chosen] / 255.0
    middle = np.median(centers, axis=0)
    reach = 2.0 * float(np.linalg.norm(centers - middle, axis=1).max() or 1.0)
    length = 0.12 * reach
    figure = Figure(figsize=(12, 6.4), layout="constrained")
    figure.suptitle(title, fontsize=10)
    for number, (name, one, other) in enumerate((("from above", 0, 1), ("from the side", 0, 2)), start=1):
        plot = figure.add_subplot(1, 2, number, aspect="equal")
        plot.scatter(points[:, one], points[:, other], s=1, c=colors, linewidths=0)
        for center, look in zip(centers, looks, strict=True):
            plot.plot(*np.stack([center, center + length * look])[:, [one, other]].T, color="tab:red", linewidth=0.8)
        plot.scatter(centers[:, one], centers[:, other], s=9, c="tab:red")
        plot.set(xlim=middle[one] + np.array([-reach, reach]), ylim=middle[other] + np.array([-reach, reach]))
        plot.set(title=name, xticks=[], yticks=[])
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=100))
