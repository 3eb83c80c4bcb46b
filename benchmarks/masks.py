"""Effects of checking and snapping masks: python -m benchmarks.masks swaps|parts|rims [SCENE ...].

A SCENE is a folder, or sample-mild or sample-strong: written anew by `beags sample` with that damage, in a
temporary folder; these two if none is named.
swaps: exchanges ids in some views of scenes with good masks, and counts these views and others that the check names; a
row of a table in Markdown for each scene. parts: cuts the foot off an object, or adds the ground at it, in one view of
four, and counts these views among as many that the check names first, and other views that it names; with SCENE=RUN
also at the depths of a trained run. rims: makes the boundaries of exact masks ragged, snaps them to edges of the photo,
and compares both with the exact ones.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

SHARES = (0.02, 0.1, 0.2, 0.3)  # of the views whose ids are exchanged
SEEDS = 5
PARTS = (0.15, 0.35)  # least and most of an object that is cut off or added
RAGGED = (0.002, 0.004, 0.009)  # of the image diagonal
RADII = (2, 4, 8)
MOST_VIEWS = 12
SAMPLES = ("sample-mild", "sample-strong")


@contextmanager
def folder_of(scene: str) -> Iterator[Path]:
    """Yield the folder of a scene; a sample is deleted afterwards."""
    if scene not in SAMPLES:
        yield Path(scene).absolute()
        return
    from beags_plugin.sample.writer import make_sample

    with tempfile.TemporaryDirectory() as folder:
        make_sample(Path(folder) / scene, 0, 256, 192, scene.removeprefix("sample-"), 60)
        yield Path(folder) / scene


def swaps(data: Path) -> None:
    """Exchange two objects (or the only one and the background) in some views, and look for it."""
    from beags_plugin.masks.check.consistency import LEAST_POINTS, Agreement
    from beags_plugin.objects.check_masks import agreement_of, data_options

    labels, classes = agreement_of(data_options(data))
    usable = [view for view in range(labels.shape[1]) if (labels[:, view] >= 0).any()]
    cells = [f"{data.name}, {classes - 1} objects, {len(usable)} views"]
    before = {renamed.view for renamed in Agreement(labels, classes).renamed()}
    others = set()
    for share in SHARES:
        planted = found = 0
        for seed in range(SEEDS):
            generator = np.random.default_rng(seed)
            changed, table = {}, labels.copy()
            for view in generator.choice(usable, max(1, round(share * len(usable))), replace=False):
                column = table[:, view]
                shown = [c for c in range(1, classes) if (column == c).sum() >= LEAST_POINTS] if classes > 2 else [0, 1]
                if len(shown) < 2:
                    continue
                first, second = (int(c) for c in generator.choice(shown, 2, replace=False))
                table[:, view] = np.select([column == first, column == second], [second, first], column)
                changed[int(view)] = {first, second}
            named: dict[int, set[int]] = {}
            for renamed in Agreement(table, classes).renamed():
                named.setdefault(renamed.view, set()).update(renamed.instead)
            planted += len(changed)
            found += sum(pair <= named.get(view, set()) for view, pair in changed.items())
            others |= named.keys() - changed.keys()
        cells.append(f"{found} of {planted}")
    print(f"| {' | '.join(cells)} | {len(before)} | {len(others)} |", flush=True)


def parts(data: Path, run: Path | None = None) -> None:
    """Damage an object in one view of four, every second time by ground that is added, and look for these views."""
    from beags_plugin.labels.classes import read_id_mask, write_mask
    from beags_plugin.objects.check_masks import check, options_beside

    def checked(masks: Path | None) -> tuple[list[str], dict[str, list[str]]]:
        """Return the training views, and those that each kind of evidence names, the worst first."""
        report = check(options_beside(run, data, masks_path=masks), run=run)
        kinds = ("points", "pixels") if run is not None else ("points",)
        named = {kind: dict.fromkeys(one.view for one in report.contradictions if one.of == kind) for kind in kinds}
        trained = [stem for stem, used in zip(report.stems, report.trained, strict=True) if used]
        return trained, {kind: list(views) for kind, views in named.items()}

    exact = {path.stem: read_id_mask(path) for path in sorted((data / "masks").glob("*.png"))}
    trained, before = checked(None)
    rows = {kind: np.array([len(views), 0, 0, 0]) for kind, views in before.items()}
    for seed in range(SEEDS):
        generator = np.random.default_rng(seed)
        with tempfile.TemporaryDirectory() as folder:
            damaged = generator.choice(trained, len(trained) // 4, replace=False).tolist()
            for index, stem in enumerate(damaged + sorted(set(exact) - set(damaged))):
                mask = damaged_mask(exact[stem], index % 2 == 1, generator) if stem in damaged else exact[stem]
                write_mask(Path(folder) / f"{stem}.png", mask)
            for kind, views in checked(Path(folder))[1].items():
                first = set(views[: len(damaged)]) & set(damaged)
                rows[kind] += [0, len(first), len(damaged), len(set(views) - set(damaged))]
    for kind, (names, found, planted, others) in rows.items():
        print(f"| {data.name}, {len(trained)} views, {kind} | {names} | {found} of {planted} | {others} |", flush=True)


def damaged_mask(mask: np.ndarray, add: bool, generator: np.random.Generator) -> np.ndarray:
    """Return a mask without an object's part towards the foot of the photo, or with the ground about this foot."""
    import cv2

    mask, share = mask.copy(), generator.uniform(*PARTS)
    class_id = int(generator.choice(np.unique(mask[(mask != 0) & (mask != 65535)])))
    y, x = np.nonzero(mask == class_id)
    if not add:
        angle = generator.uniform(-0.6, 0.6)
        along = y * np.cos(angle) + x * np.sin(angle)
        cut = along >= np.quantile(along, 1 - share)
        mask[y[cut], x[cut]] = 0
        return mask
    centre = int(generator.uniform(*np.quantile(x, (0.25, 0.75)))), int(y.max())
    ground, width = np.zeros(mask.shape, bool), 0.25 * np.ptp(x) + 4
    while ground.sum() < share * len(y) and width < max(mask.shape):
        disc = np.zeros(mask.shape, np.uint8)
        cv2.ellipse(disc, centre, (int(width), int(0.4 * width)), 0, 0, 360, 1, -1)
        ground, width = (disc == 1) & (mask == 0), 1.08 * width
    mask[ground] = class_id
    return mask


def rims(data: Path) -> None:
    """Print IoU and BIoU of ragged and of snapped masks, mean over objects and views."""
    from beags_plugin.evaluation.metrics import mask_metrics, mean_metrics
    from beags_plugin.labels.classes import read_id_mask
    from beags_plugin.masks.snapping import snap_to_edges
    from beags_plugin.sample.degrade import rim_amplitude, roughen_rims

    folder = data / "ground_truth/masks" if (data / "ground_truth/masks").is_dir() else data / "masks"
    photos = {path.stem: path for path in (data / "images").iterdir()}
    files = sorted(path for path in folder.glob("*.png") if path.stem in photos)
    files = files[:: -(-len(files) // MOST_VIEWS)]
    for strength in RAGGED:
        rows: dict[str, list] = {name: [] for name in ("ragged", *(f"snapped, radius {r}" for r in RADII))}
        for path in files:
            exact, photo = read_id_mask(path), read_photo(photos[path.stem])
            ragged = roughen_rims(exact, rim_amplitude(strength, *exact.shape), 0, path.stem)
            variants = {"ragged": ragged} | {f"snapped, radius {r}": snap_to_edges(ragged, photo, r) for r in RADII}
            for name, mask in variants.items():
                ids = [int(i) for i in np.unique(exact) if 0 < i < 65535]
                rows[name] += [mask_metrics(mask == i, exact == i) for i in ids]
        print(f"{data.name}: rims moved by up to {strength} of the diagonal, {len(files)} views")
        for name, found in rows.items():
            mean = mean_metrics(found)
            print(f"  {name:20s} IoU {100 * mean.iou:.2f}  BIoU {100 * mean.biou:.2f}", flush=True)


def main(what: str, scenes: Sequence[str]) -> None:
    """Measure the scenes one after the other."""
    if what == "swaps":
        print(
            f"| scene | {' | '.join(f'{100 * share:g} % of the views' for share in SHARES)} | named before | others |"
        )
        print("|---" * (len(SHARES) + 3) + "|")
    if what == "parts":
        print(
            "| scene | views named in the masks as they are | damaged views named first | others |\n|---|---|---|---|"
        )
    for scene in scenes:
        name, _, run = scene.partition("=")
        with folder_of(name) as folder:
            if what == "parts":
                parts(folder, Path(run) if run else None)
            else:
                {"swaps": swaps, "rims": rims}[what](folder)


def read_photo(path: Path) -> np.ndarray:
    """Return a photo as [H, W, 3] uint8."""
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:] or SAMPLES)
