"""Pictures of the objects of a run: turntables, sheets, and before beside after."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import get_args

import torch

from beags_plugin.core.cameras import Camera, viewmat_from_opengl
from beags_plugin.core.select import select_class
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.objects.clean import Cleaner, cleaner_of
from beags_plugin.objects.export import Progress
from beags_plugin.objects.extract import chosen_objects, folder_names, objects_with_gaussians
from beags_plugin.objects.shown import Shown
from beags_plugin.pictures.cells import write_picture
from beags_plugin.pictures.objects import Subject, comparison, film, sheet
from beags_plugin.pictures.options import PictureFormat, RenderOptions
from beags_plugin.pictures.orbit import orbit, orbit_frame, orbit_settings
from beags_plugin.pictures.video import FILMS, check_film, encoder, write_film
from beags_plugin.runs.layout import BASE_SNAPSHOT
from beags_plugin.runs.read import SavedScene
from beags_plugin.runs.run import Run
from beags_plugin.surfaces.frames import bounding_box
from beags_plugin.system.errors import UserError, check_choice
from beags_plugin.system.reading.text import load_json, reason

_PICTURES = (".png", ".jpg", ".jpeg")
_MOST_PIXELS, _MOST_CAMERAS = 8192, 100_000  # bounds of a camera path: of a side, and of its length


def render_run(
    config_path: Path,
    objects: Sequence[str] = (),
    form: str = "video",
    output: Path | None = None,
    options: RenderOptions | None = None,
    progress: Progress | None = None,
    data: Path | None = None,
) -> Path:
    """Render objects of a run alone, as their files have them, from cameras around each; return the one file's path.

    config_path: config.yml of a refined (or assigned) run. objects: names; all but the background if empty. form:
    "video" (.mp4, .gif), "sheet" (.png, .jpg), or "before-after", either kind of file with the object before and after
    refinement from the same cameras. output: the file; in ``renders/`` of the run if None. progress: receives (done,
    total) pictures. data: folder of the scene if it has moved. Raises ``UserError`` for a mistake, before anything is
    rendered.
    """
    run, options = Run(config_path, data), options or RenderOptions()
    options.check()
    check_choice(form, get_args(PictureFormat), "format")
    if options.camera_path is not None:
        return _along(options.camera_path, run, objects, form, output, options, progress)
    scene = run.assigned
    chosen = chosen_objects(scene, objects, run.folder)
    if output is None:
        title = folder_names(scene.classes)[next(iter(chosen.values()))] if len(chosen) == 1 else "objects"
        suffix = ".png" if form != "video" else _film_suffix()
        output = run.folder / "renders" / f"{title}_{form}{suffix}"
    moving = _check_output(output, form)
    stages = {"": scene} if form != "before-after" else {"before": _base_of(run), "after": scene}
    subjects = _subjects(run, stages, chosen, form, moving, options)
    if moving:
        write_film(output, film(subjects, run.rasterizer, options.background, progress), options.fps)
    else:
        draw = comparison if form == "before-after" else sheet
        write_picture(output, draw(subjects, run.rasterizer, options.background, progress))
    return output


def _film_suffix() -> str:
    return ".gif" if encoder() is None else ".mp4"


def _along(
    path: Path,
    run: Run,
    objects: Sequence[str],
    form: str,
    output: Path | None,
    options: RenderOptions,
    progress: Progress | None,
) -> Path:
    """Film the objects of a run together, or the whole scene, along a camera path; arguments as of ``render_run``."""
    if form == "sheet":
        raise UserError("a camera path gives a video: leave --format sheet or --camera-path out.")
    changed = {each.name for each in fields(options) if getattr(options, each.name) != each.default}
    if ignored := sorted(changed - {"background", "camera_path"}):
        raise UserError(f"a camera path has a size, cameras and speed of its own: leave --{ignored[0]} out.")
    cameras, fps = read_camera_path(path)
    output = output or run.folder / "renders" / f"{path.stem}_{form}{_film_suffix()}"
    check_film(output)
    scene = run.assigned if objects or form != "video" else run.scene
    stages = {"": scene} if form == "video" else {"before": _base_of(run), "after": scene}
    present = objects_with_gaussians(scene, objects, run.folder) if objects else {}
    parts, cleaner = {}, cleaner_of(Shown(run))
    for caption, each in stages.items():
        rows = [_part(run, each, present[name], cleaner)[1] for name in objects]
        parts[caption] = each.surfels()[torch.cat(rows).unique()] if rows else each.surfels()
    subject = Subject("", parts, cameras, run.settings)
    write_film(output, film([subject], run.rasterizer, options.background, progress), fps)
    return output


def _check_output(path: Path, form: str) -> bool:
    """Return whether the file is a film; raise ``UserError`` for a name that does not fit the format."""
    suffix = path.suffix.lower()
    if form == "video" or (form == "before-after" and suffix in FILMS):
        check_film(path)
        return True
    if suffix not in _PICTURES:
        films = " (or .mp4, .gif)" if form == "before-after" else ""
        raise UserError(f"the picture {path} is no .png or .jpg{films}: give it such a name.")
    return False


def _base_of(run: Run) -> SavedScene:
    """Return the state before refinement, which a refined run has saved."""
    snapshot = run.folder / BASE_SNAPSHOT / "config.yml"
    if not snapshot.exists():
        raise UserError(
            f"{run.folder} has no saved state from before refinement ({BASE_SNAPSHOT}/): name the run that was "
            "refined, or another --format."
        )
    return Run(snapshot).assigned


def _part(run: Run, scene: SavedScene, class_id: int, cleaner: Cleaner) -> tuple[Surfels, torch.Tensor]:
    """Return an object and its rows [K] int64 in the scene; of the run's own scene as its file has it."""
    part, index = select_class(scene.surfels(), scene.members, class_id)
    if scene is run.assigned and class_id != BACKGROUND:
        part, index, _ = cleaner.clean(part, index, class_id)
    return part, index


def _subjects(
    run: Run,
    stages: dict[str, SavedScene],
    chosen: dict[str, int],
    form: str,
    moving: bool,
    options: RenderOptions,
) -> list[Subject]:
    try:
        photos = run.viewpoints.cameras
    except UserError:  # the data are missing; z of nerfstudio's frame is up
        photos = []
    count = options.frames if moving else options.views
    if form == "before-after" and not moving:
        count = max(1, count // 2)
    size = options.size or (480 if moving else 400 if form == "before-after" else 232)
    subjects, cleaner = [], cleaner_of(Shown(run))
    for name, class_id in chosen.items():
        parts = {}
        for caption, scene in stages.items():
            parts[caption], _ = _part(run, scene, class_id, cleaner)
        stand = orbit_frame(*bounding_box(list(parts.values())[-1]), photos)
        cameras = orbit(stand, count, size, options.elevation, options.turn)
        subjects.append(Subject(name, parts, cameras, orbit_settings(stand)))
    return subjects


def read_camera_path(path: Path) -> tuple[list[Camera], int]:
    """Read a camera path that nerfstudio's viewer has saved; raise ``UserError`` for another file or lens.

    Returns the cameras, in the run's frame, and the frames per second.
    """
    try:
        content = load_json(path)
        width, height, fps = (content[name] for name in ("render_width", "render_height", "fps"))
        if (lens := str(content.get("camera_type", "perspective")).lower()) != "perspective":
            raise ValueError(f"its camera is {lens}, not perspective")
        if not (min(width, height) >= 2 and max(width, height) <= _MOST_PIXELS and 1 <= fps <= 240):
            raise ValueError(f"it asks for {width} x {height} pixels, {fps} times a second")
        if not 1 <= len(content["camera_path"]) <= _MOST_CAMERAS:
            raise ValueError(f"it has {len(content['camera_path'])} cameras")
        poses = [torch.tensor(each["camera_to_world"]).view(4, 4)[:3].float() for each in content["camera_path"]]
        focals = [height / 2.0 / math.tan(each["fov"] * (math.pi / 180.0) / 2.0) for each in content["camera_path"]]
        if not (all(bool(pose.isfinite().all()) for pose in poses) and 0 < min(focals) < math.inf):
            raise ValueError("a pose or a field of view is no number")
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, ArithmeticError) as error:
        raise UserError(
            f"the camera path {path} cannot be read ({reason(error)}): save one in the tab Render of ns-viewer."
        ) from error
    return [_camera(pose, focal, width, height) for pose, focal in zip(poses, focals, strict=True)], round(fps)


def _camera(pose: torch.Tensor, focal: float, width: int, height: int) -> Camera:
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(viewmat_from_opengl(pose), K, int(width / 2 * 2), int(height / 2 * 2))
