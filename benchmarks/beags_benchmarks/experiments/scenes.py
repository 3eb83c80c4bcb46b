"""Scenes of an experiment on disk: generated samples, the user's folders, and damaged copies of masks."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.classes import read_id_mask, write_mask
from beags_plugin.system.digests import folder_digest, value_digest
from beags_plugin.system.errors import UserError, writing
from beags_plugin.system.progress import progress_bar
from beags_plugin.system.reading.arrays import load_array
from beags_plugin.system.whole_files import write_text_atomically

if TYPE_CHECKING:
    from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs

    from beags_benchmarks.samples.config import VariedSample
    from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig

SEEDS = {"choosing": (0, 1, 2), "reporting": (100, 101, 102, 103, 104)}
"""Seeds of generated scenes; results on the seeds for reporting must not decide on choices."""


def quiet() -> contextlib.AbstractContextManager[object]:
    """Drop what is printed in the block: nerfstudio lists its splits."""
    return contextlib.redirect_stdout(io.StringIO())


@dataclass(frozen=True)
class TrialScene:
    """A scene to train on.

    digest: changes with the source of ``data``; for the user's data it covers path, sizes and times of files. seed:
    seed of the damage to masks. options: options of ``beags-data`` by name, as plain values. sample: config of a
    generated scene, which a plan does not write. photos: the scene that its base is trained on; None for this scene.
    """

    name: str
    data: Path
    downscale: float
    digest: str
    seed: int = 0
    options: Mapping[str, Any] = field(default_factory=dict, hash=False)
    sample: VariedSample | None = field(default=None, compare=False)
    photos: TrialScene | None = field(default=None, compare=False)

    @property
    def unwritten(self) -> VariedSample | None:
        """Return the config of a generated scene that is not on disk; None for others."""
        return None if self.data.exists() else self.sample

    def parser(self) -> BeagsDataParserConfig:
        """Return the data parser's config, without ``downscale``."""
        from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig

        return BeagsDataParserConfig(data=self.data, **parser_options(self.options))


@dataclass(frozen=True)
class SceneSize:
    """Numbers of training views and of their pixels, at the resolution of training."""

    views: int
    pixels: int

    @classmethod
    def of(cls, outputs: DataparserOutputs) -> SceneSize:
        """Return the size of the training views that a data parser returned."""
        cameras = outputs.cameras
        return cls(len(outputs.image_filenames), int((cameras.width.long() * cameras.height.long()).sum()))


def scene_size(scene: TrialScene) -> SceneSize:
    """Return the size of a scene, read from disk if it is there; raises ``UserError`` if it cannot be read."""
    if (sample := scene.unwritten) is not None:
        return SceneSize(sample.num_train, sample.num_train * sample.width * sample.height)
    parser = scene.parser()
    parser.downscale_factor = scene.downscale
    with quiet():
        return SceneSize.of(parser.setup().get_dataparser_outputs("train"))


def parser_options(plain: Mapping[str, Any]) -> dict[str, Any]:
    """Return plain options of ``beags-data`` with their paths as ``Path`` and lists as tuples."""
    lists = {name: tuple(value) for name, value in plain.items() if isinstance(value, list)}
    return {name: Path(value) if name.endswith("_path") else value for name, value in plain.items()} | lists


def sample_scene(folder: Path, family: str, seed: int, options: Mapping[str, Any], write: bool = True) -> TrialScene:
    """Return the generated scene of that family and seed; write it into ``folder`` unless it is there."""
    from beags_benchmarks.samples.config import VariedSample
    from beags_plugin.sample.writer import is_sample, write_sample

    config = VariedSample(**{**options, "family": family, "seed": seed})
    digest = value_digest(config.as_dict())
    target = folder / f"{family}-{seed}-{digest[:8]}"
    config.check()
    if write and not is_sample(target, config):
        with progress_bar(f"Tracing {family} {seed}") as progress:
            write_sample(target, config, progress)
    return TrialScene(f"{family} {seed}", target, 1.0, digest, seed, sample=config)


def given_scenes(folders: Sequence[Path], downscale: float | None) -> list[TrialScene]:
    """Return the user's scenes, scaled down for a quick run unless ``downscale`` is given.

    Raises ``UserError`` for a folder that does not exist, and for two of one name.
    """
    from beags_plugin.views.quick import quick_downscale

    scenes = []
    for folder in folders:
        if not folder.is_dir():
            raise UserError(f"{folder} is no folder: name one with images, poses and masks.")
        name = folder.resolve().name
        if any(scene.name == name for scene in scenes):
            raise UserError(f"two of the given folders are called {name}: rename one of them.")
        scenes.append(TrialScene(name, folder.resolve(), downscale or quick_downscale(folder), folder_digest(folder)))
    return scenes


def damaged_masks(scene: TrialScene, degree: float, folder: Path, write: bool = True) -> Path:
    """Return a folder with the scene's masks, those of the training views damaged to ``degree`` (1 is mild, 2 strong).

    Exact masks (``ground_truth/masks``) are damaged if the scene has them, else its own masks. The scene's seed and the
    view's name determine the damage. At degree 1 a sample gets its default masks; damage that its views share comes
    first, if the experiment generates it. Masks of held-out views stay unchanged. An existing folder of the same damage
    is reused. Without ``write`` only the folder's name is returned.
    """
    from beags_benchmarks.samples import damage
    from beags_plugin.sample import degrade

    degradation = damage.degradation_of_degree(degree)
    code = [Path(str(file)).read_text("utf8") for file in (degrade.__file__, damage.__file__, __file__)]
    target = folder / f"masks-{value_digest([scene.digest, scene.seed, degree, code])[:12]}"
    if not write or _is_whole(target):
        return target
    parser = scene.parser().setup()
    with quiet():
        splits = {split: parser.get_dataparser_outputs(split) for split in ("test", "train")}
    stems = [Path(file).stem for file in splits["train"].image_filenames]
    dropped = degrade.dropped_views(stems, scene.seed, degradation.dropped)
    flawed = _shared_damage(scene.sample)
    for split, outputs in splits.items():  # the second split, training, overwrites views that are in both
        classes = np.array(sorted(outputs.metadata["classes"]))
        masks = _best_masks(outputs.metadata, split)
        for image, mask in zip(outputs.image_filenames, masks, strict=True):
            if mask is None or (split == "train" and image.stem in dropped):
                continue
            labels = read_id_mask(mask, outputs.metadata["ignore_ids"])
            if split == "train":
                if flawed is not None:
                    depth = load_array(scene.data / f"ground_truth/depth/{image.stem}.npy")
                    labels = flawed(labels, depth, image.stem)
                ranks = np.where(labels == IGNORE, len(classes), np.searchsorted(classes, labels))
                ranks = degrade.degrade_mask(ranks, len(classes), degradation, scene.seed, image.stem)
                labels = np.append(classes, IGNORE)[ranks]
            root = scene.data / "images"  # the data parser looks for masks by the path below it
            path = target / (image.relative_to(root) if image.is_relative_to(root) else image.name)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_mask(path.with_suffix(".png"), labels.astype(np.uint16))
    (target / "complete").touch()
    return target


def class_masks(scene: TrialScene, count: int, folder: Path, write: bool = True) -> Path:
    """Return a folder with masks of ``count`` objects for the training views, to measure what classes cost.

    The objects are cells around seed points: each pixel has the cell of the nearest point in the picture, occluded or
    not. Held-out views have no masks, so that no quality is scored. Without ``write`` only the folder's name is
    returned.
    """
    import torch
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (compiled, without stubs)
    from sklearn.cluster import KMeans

    from beags_plugin.core.lifting import project
    from beags_plugin.views.cameras import camera_from_nerfstudio

    code = Path(__file__).read_text("utf8")
    target = folder / f"classes-{value_digest([scene.digest, count, code])[:12]}"
    if not write or _is_whole(target):
        return target
    with quiet():
        outputs = scene.parser().setup().get_dataparser_outputs("train")
    points = outputs.metadata["points3D_xyz"]
    cells = KMeans(count, n_init=1, random_state=0).fit_predict(points.numpy())  # pyright: ignore[reportArgumentType]
    for index, image in enumerate(outputs.image_filenames):
        camera = camera_from_nerfstudio(outputs.cameras, index)
        xy, z = project(points, camera)
        before = (z > 0).numpy()
        pixels = torch.cartesian_prod(torch.arange(camera.height), torch.arange(camera.width)).flip(1) + 0.5
        nearest = cKDTree(xy[z > 0].numpy()).query(pixels.numpy())[1]
        labels = 1 + cells[before][nearest].reshape(camera.height, camera.width)
        write_mask(target / f"{image.stem}.png", labels.astype(np.uint16))
    write_text_atomically(json.dumps({c: f"cell {c}" for c in range(1, count + 1)}), target / "classes.json")
    (target / "complete").touch()
    return target


def _shared_damage(config: VariedSample | None) -> Callable[[np.ndarray, np.ndarray, str], np.ndarray] | None:
    """Return a function (mask, depth, name) that adds the damage shared by views to an exact mask; None without any."""
    if config is None or not config.shared_damage:
        return None
    from beags_plugin.sample import FAMILIES

    family = FAMILIES.get(config.family)
    views = family.views(config.seed, config.width, config.height, config.num_train, config.num_test)
    train = {view.name: view for view in views if view.split == "train"}
    flawed = config.flaws(family.scene(config.seed), list(train))
    return lambda labels, depth, name: flawed(labels, depth, train[name])


def _is_whole(target: Path) -> bool:
    """Return whether a folder of made masks is complete; if not, empty it."""
    if (target / "complete").exists():
        return True
    shutil.rmtree(target, ignore_errors=True)
    with writing(target):
        target.mkdir(parents=True)
    return False


def _best_masks(metadata: dict[str, Any], split: str) -> list[Path | None]:
    """Return each view's mask: the exact mask of a training view if there is one, else the given mask."""
    given: list[Path | None] = metadata["mask_filenames"]
    truth = metadata["ground_truth"]
    exact = truth["masks"] if truth and split == "train" else [None] * len(given)
    return [best or mask for best, mask in zip(exact, given, strict=True)]
