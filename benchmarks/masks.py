"""Effects of checking and snapping masks: python -m benchmarks.masks swaps|rims [SCENE ...].

A SCENE is a folder, or sample-mild or sample-strong: written anew by `beags sample` with that damage, in a
temporary folder; these two if none is named.
swaps: exchanges ids in some views of scenes with good masks, and counts these views and others that the check names; a
row of a table in Markdown for each scene. rims: makes the boundaries of exact masks ragged, snaps them to edges of the
photo, and compares both with the exact ones.
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
    from beags_plugin.plugin.objects.check_masks import agreement_of, data_options

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
    for scene in scenes:
        with folder_of(scene) as folder:
            {"swaps": swaps, "rims": rims}[what](folder)


def read_photo(path: Path) -> np.ndarray:
    """Return a photo as [H, W, 3] uint8."""
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:] or SAMPLES)
