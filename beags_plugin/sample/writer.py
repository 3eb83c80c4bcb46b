"""Write the sample scene as a nerfstudio folder with masks and ground truth."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beags_plugin.sample import FAMILIES
from beags_plugin.sample.degrade import Degradation, degrade_mask, dropped_views, resolve_degradation
from beags_plugin.sample.family import Family
from beags_plugin.sample.points import Photo, SeedPoints, find_tracks, seed_points
from beags_plugin.sample.scene import Scene
from beags_plugin.sample.shots import Shot, taken
from beags_plugin.sample.views import Picture, View, render_pixels
from beags_plugin.system.errors import UserError, unwritable, writing
from beags_plugin.system.progress import progress_bar
from beags_plugin.system.reading.ply import write_vertices

VERSION = 13
"""Raise it whenever the same config gives other files: older samples are then rebuilt."""
LARGEST_SIDE = 8192  # pixels
POINT_NOISE = 0.03
"""Noise of seed points, world units: two to three pixels at 256 x 192, as in a hand-held capture."""
SAMPLE_FILE, TRACKS_FILE = "sample.json", "seed_tracks.json"
ALIKE = {"exposure": 0.0, "white_balance": 0.0, "moved": 0, "shared_damage": 0.0}
"""Entries of sample.json for the options that only samples of benchmarks/ have: they are off."""
Flawed = Callable[[np.ndarray, np.ndarray, View], np.ndarray]
"""Function of the exact mask and depth [H, W] of a training photo and its view; returns the mask with shared errors."""


@dataclass(frozen=True)
class SampleConfig:
    """Options that decide every byte of the sample.

    family: "tabletop" (solids on the ground, seen from all sides), "desk" (textured things that touch in a room), or
        one of another package.
    seed: decides arrangement, sizes, colours, textures, light, camera jitter, mask degradation.
    width, height: pixels. num_train, num_test: numbers of views.
    degradation: errors of the train masks: "none", "mild", "strong", or a ``Degradation``.
    num_points: seed points. antialias: rays per pixel, along each axis, for the images.

    All photos have the same exposure and show the same scene. A subclass can change photos in ``shots``, and masks in
    ``damage`` and ``flaws``.
    """

    seed: int = 0
    width: int = 320
    height: int = 240
    num_train: int = 60
    num_test: int = 12
    degradation: str | Degradation = "mild"
    num_points: int = 2000
    antialias: int = 2
    family: str = "tabletop"

    def check(self) -> None:
        """Raise ``UserError`` for a value that makes no scene."""
        least = {"seed": 0, "width": 16, "height": 16, "num_train": 1, "num_test": 1, "num_points": 1, "antialias": 1}
        for name, low in least.items():
            if getattr(self, name) < low:
                raise UserError(f"the sample's {name} is {getattr(self, name)}: give at least {low}.")
        for name in ("width", "height"):
            if getattr(self, name) > LARGEST_SIDE:
                raise UserError(f"the sample's {name} is {getattr(self, name)}: give at most {LARGEST_SIDE}.")
        FAMILIES.check(self.family)
        self.damage()

    def as_dict(self) -> dict[str, Any]:
        """Return the content of sample.json, with presets spelled out, so that a changed preset is another sample."""
        entries = {"version": VERSION, **asdict(self), "degradation": asdict(self.damage())}
        return {**entries, **{name: value for name, value in ALIKE.items() if name not in entries}}

    def damage(self) -> Degradation:
        """Return the errors that each train mask has for itself; raises ``UserError`` for an unknown name."""
        return resolve_degradation(self.degradation)

    def shots(self, family: Family, views: list[View]) -> list[Shot]:
        """Return the photo to take of each view."""
        scene = family.scene(self.seed)
        light = family.light(scene)
        return [Shot(view, scene, scene, light, light) for view in views]

    def flaws(self, scene: Scene, train: Sequence[str]) -> Flawed:
        """Return a function that adds the errors which masks of the training photos, by name, share: here none."""
        return lambda labels, depth, view: labels


def is_sample(folder: Path, config: SampleConfig) -> bool:
    """Return whether ``folder`` holds the complete sample of this config."""
    try:
        return json.loads((folder / SAMPLE_FILE).read_text(encoding="utf-8")) == config.as_dict()
    except (OSError, ValueError):  # The file is missing or damaged.
        return False


def write_sample(
    folder: str | os.PathLike[str],
    config: SampleConfig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write the sample scene into ``folder``, unless it holds that sample already; returns the folder.

    Layout: transforms.json (OpenGL camera-to-world, world z up), images/<stem>.png, masks/<stem>.png (ids; degraded
    for train views, none for dropped ones, exact for test views), classes.json, seed_points.ply, and under
    ground_truth/ the exact masks/<stem>.png, silhouettes/<object>/<stem>.png (0 or 255), and depth/<stem>.npy (float32,
    z along the optical axis); masks and depth are those of the pixel centres. sample.json is the config.
    seed_tracks.json lists the training photos that show each seed point: ``photos``, their stems, and ``points``,
    indices of photos for each point of seed_points.ply. Seed points have the colours of the mean exposure.

    All is written into a temporary folder beside ``folder`` and renamed at the end, so that an interrupted run leaves
    nothing. A folder that holds another sample is replaced; one that another program has made of ``config`` meanwhile
    stays. progress: called as ``progress(done, total)`` after each view.
    Raises ``UserError`` for a bad config, or if ``folder`` holds something that is no sample.
    """
    config = config or SampleConfig()
    config.check()
    target = Path(folder).absolute()
    if is_sample(target, config):
        return target
    if target.exists() and (not target.is_dir() or (any(target.iterdir()) and not (target / SAMPLE_FILE).is_file())):
        raise UserError(f"{target} exists and is no sample scene: choose another folder or empty it.")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{target.name}.partial-", dir=target.parent))
    except OSError as error:
        raise unwritable(target, error) from error
    try:
        built = partial / "new"
        with writing(target):
            _build(built, config, progress)
            try:
                if is_sample(target, config):  # Another program has made it meanwhile.
                    return target
                if (target / SAMPLE_FILE).is_file():
                    target.rename(partial / "old")
                built.rename(target)
            except OSError:
                if not is_sample(target, config):
                    raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return target


def _build(folder: Path, config: SampleConfig, progress: Callable[[int, int], None] | None) -> None:
    family = FAMILIES.get(config.family)
    views = family.views(config.seed, config.width, config.height, config.num_train, config.num_test)
    shots = config.shots(family, views)
    degradation = config.damage()
    train = [view.name for view in views if view.split == "train"]
    flawed = config.flaws(shots[0].still, train)
    dropped = dropped_views(train, config.seed, degradation.dropped)
    ends = [config.num_points * i // len(train) for i in range(len(train) + 1)]
    shares = {name: end - first for name, first, end in zip(train, ends[:-1], ends[1:], strict=True)}
    names = shots[0].still.class_names
    objects = [f"ground_truth/silhouettes/{name}" for class_id, name in names.items() if class_id]
    for sub in ("images", "masks", "ground_truth/masks", "ground_truth/depth", *objects):
        (folder / sub).mkdir(parents=True)
    seeds: list[SeedPoints] = []
    photos: list[Photo] = []  # the training photos
    for done, (shot, picture) in enumerate(taken(shots, config.antialias), start=1):
        view, scene = shot.view, shot.scene
        _write_truth(folder, view, picture, names)
        _write_png(folder / "images" / f"{view.name}.png", picture.image)
        mask = picture.labels
        if view.split == "train":
            photos.append(Photo(view, scene))
            mask = flawed(mask, picture.depth, view)
            mask = degrade_mask(mask, len(names), degradation, config.seed, view.name)
            # Each view has a generator, so that its points do not depend on other pictures.
            generator = np.random.default_rng([config.seed, 6, done])
            points = seed_points(view, picture, shot.lasting(picture), shares[view.name], POINT_NOISE, generator)
            if shot.exposed is not shot.light:  # The points have the colours of the mean exposure.
                points.paint(render_pixels(scene, shot.light, view, points.pixels, config.antialias))
            seeds.append(points)
        if view.name not in dropped:
            _write_png(folder / "masks" / f"{view.name}.png", mask)
        if progress is not None:
            progress(done, len(views))
    with open(folder / "seed_points.ply", "wb") as file:
        write_vertices(file, np.concatenate([points.records for points in seeds]))
    tracks = {"photos": train, "points": find_tracks(seeds, photos, family.turns)}
    (folder / TRACKS_FILE).write_text(json.dumps(tracks) + "\n", encoding="utf-8")
    _write_json(folder / "classes.json", {str(i): name for i, name in names.items()})
    _write_json(folder / "transforms.json", transforms(views))
    _write_json(folder / SAMPLE_FILE, config.as_dict())


def transforms(views: list[View]) -> dict[str, Any]:
    """Return nerfstudio's transforms.json: one lens, frames sorted by name, and the split."""
    lens = views[0]

    def of(split: str) -> list[str]:
        return [f"images/{view.name}.png" for view in views if view.split == split]

    return {
        "camera_model": "OPENCV",
        "fl_x": lens.focal,
        "fl_y": lens.focal,
        "cx": lens.cx,
        "cy": lens.cy,
        "w": lens.width,
        "h": lens.height,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "ply_file_path": "seed_points.ply",
        "train_filenames": of("train"),
        # nerfstudio reads "val" while training, and refuses a file that names other splits but not this one.
        "val_filenames": of("test"),
        "test_filenames": of("test"),
        "frames": [
            {"file_path": f"images/{view.name}.png", "transform_matrix": view.camera_to_world.tolist()}
            for view in views
        ],
    }


def _write_truth(folder: Path, view: View, picture: Picture, names: dict[int, str]) -> None:
    truth = folder / "ground_truth"
    _write_png(truth / "masks" / f"{view.name}.png", picture.labels)
    np.save(truth / "depth" / f"{view.name}.npy", picture.depth)
    for class_id, silhouette in enumerate(picture.silhouettes, start=1):
        _write_png(truth / "silhouettes" / names[class_id] / f"{view.name}.png", np.uint8(255) * silhouette)


def _write_png(path: Path, pixels: np.ndarray) -> None:
    """Write an image [H, W] uint8 grey or [H, W, 3] uint8 RGB."""
    from PIL import Image

    Image.fromarray(pixels).save(path)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def make_sample(folder: Path, config: SampleConfig) -> None:
    """Write a sample into ``folder`` as ``write_sample`` does, and show the progress."""
    with progress_bar("Tracing the sample") as progress:
        write_sample(folder, config, progress)
