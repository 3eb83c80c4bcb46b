"""Masks for training on captures, by the network or cut from a base; they are made once, beside the trials."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from beags_benchmarks.experiments.captures.known import PICKED, SALIENT, FoundCapture
from beags_benchmarks.experiments.scenes import TrialScene, quiet
from beags_benchmarks.experiments.trials import Trial
from beags_plugin.system.digests import folder_digest, value_digest
from beags_plugin.system.errors import UserError, writing

KEPT = 8  # folders of masks of one kind of a capture that stay; older ones are removed
COMPLETE = "complete"


def salient_unavailable(fetch: bool) -> str | None:
    """Return a sentence on why the network cannot run here, or None; fetch: download missing weights."""
    from beags_plugin.masks.sources.salient import SalientSource, fetch_weights

    if reason := SalientSource.unavailable():
        return reason
    try:
        if fetch:
            fetch_weights()
    except UserError as error:
        return str(error)
    return None


def masked_scene(found: FoundCapture, kind: str, base: Trial, output: Path) -> TrialScene:
    """Return a capture with masks of a kind, which need not exist yet; writes nothing.

    base: training from which objects are picked. output: folder of the experiment.
    """
    masks = masks_folder(found, kind, base, output)
    options = {} if masks is None else {"masks_path": str(masks / "masks"), "classes_path": str(masks / "classes.json")}
    digest = [found.photos.digest, kind, masks and masks.name]
    if links := truth_links(found, kind, output):
        options["ground_truth_path"] = str(links[0].parent)
        digest.append(links[0].parent.name)
    name = f"{found.capture.name}, {kind}"
    return TrialScene(
        name, found.photos.data, found.photos.downscale, value_digest(digest), options=options, photos=found.photos
    )


def masks_folder(found: FoundCapture, kind: str, base: Trial, output: Path) -> Path | None:
    """Return the folder of made masks, whose name has a digest of all inputs; None for the capture's own masks."""
    from beags_plugin.masks.sources import salient

    if kind == SALIENT:
        made_of = [found.photos.digest, Path(str(salient.__file__)).read_text("utf8")]
    elif kind == PICKED:
        made_of = [base.digest, found.capture.prompts.read_text("utf8")]
    else:
        return None
    return (output / "scenes" / f"{found.capture.name}-{kind}-{value_digest(made_of)[:12]}").absolute()


def truth_links(found: FoundCapture, kind: str, output: Path) -> list[Path]:
    """Return the links to a capture's truth in a folder like ``ground_truth``; none if the capture has that folder.

    Objects with traced silhouettes are never occluded, so that a silhouette is also the visible mask.
    """
    if found.truth is not None:
        source, names = found.truth, ("silhouettes", "visible")
    elif found.capture.own_truth and kind == SALIENT:
        source, names = found.photos.data / "masks", ("masks",)
    else:
        return []
    digest = value_digest([str(source), names, folder_digest(source)])[:12]
    return [(output / "scenes" / f"{found.capture.name}-truth-{digest}" / name).absolute() for name in names]


def link_truth(found: FoundCapture, kind: str, output: Path) -> None:
    """Make missing links to a capture's truth; nothing is copied."""
    for link in truth_links(found, kind, output):
        if not link.is_symlink():
            with writing(link):
                link.parent.mkdir(parents=True, exist_ok=True)
                link.symlink_to(found.truth or found.photos.data / "masks")


def make_masks_once(found: FoundCapture, kind: str, folder: Path, run: Path | None) -> list[str]:
    """Make the masks of a capture in ``folder`` unless they exist; return lines on the result.

    run: config.yml of the base from which objects are picked. Raises ``UserError`` if no masks can be made.
    """
    from beags_plugin.masks.sources.cut import CutSource
    from beags_plugin.masks.sources.salient import SalientSource
    from beags_plugin.objects.make_masks import make_masks
    from beags_plugin.runs.run import Run

    if (folder / COMPLETE).exists():
        os.utime(folder / COMPLETE)
        return []
    source = SalientSource() if kind == SALIENT else CutSource(found.capture.prompts.absolute())
    shutil.rmtree(folder, ignore_errors=True)
    with quiet():
        opened = None if run is None else Run(run)
        lines = make_masks(found.photos.parser(), source, opened, folder, overwrite=True)
    with writing(folder):
        (folder / COMPLETE).touch()
    _remove_old(sorted(folder.parent.glob(f"{found.capture.name}-{kind}-*/{COMPLETE}")))
    return [line for line in lines if not line.startswith(" ")]


def _remove_old(complete: Sequence[Path]) -> None:
    """Remove all but the ``KEPT`` folders of masks that were used last."""
    for old in sorted(complete, key=lambda path: path.stat().st_mtime)[:-KEPT]:
        shutil.rmtree(old.parent, ignore_errors=True)
