"""Masks by the same few clicks from each source.

python -m benchmarks.prompted_masks [--refine] [--preset NAME] [--sources NAME,...] [--snap RADIUS] OUTPUT RUN [RUN ...]

Each RUN is a base (config.yml) trained on a generated scene, which has exact masks. For every object three points on
it and two beside it are placed in the training view that shows most of it (``picking.placed``). The cut takes these
alone; GrabCut, which asks for boxes and for all objects of a view, also gets the box of every object in each of these
views; ``salient`` gets nothing and is scored on all objects as one. Printed, in per cent: the mean over objects of the
mean IoU over the training views without a prompt. With --refine, the preset (``beags-fast``) refines the base with
these masks (but ``salient``'s) and with the exact ones, and the extracted BIoU of held-out views follows, the mean and
the worst object's. --snap: the outlines of masks that sources make snap to the photos, as by ``beags masks make --snap
RADIUS``. OUTPUT keeps a run for each scene, source, radius and preset; one that is there is scored as it is, even if
the masks, which are made anew, differ: name another OUTPUT after a change of the code.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from beags_plugin.labels.classes import read_classes, read_id_mask
from beags_plugin.system.shipped import shipped_names
from benchmarks.picking import placed

IGNORED = 65535
SOURCES = ("cut", "grabcut", "salient")


def prompts_of(exact: dict[str, np.ndarray], names: dict[int, str], boxes: bool) -> tuple[dict[str, Any], set[str]]:
    """Return the content of prompts.json and the views that it prompts; exact: [H, W] ids by view."""
    objects = {class_id: name for class_id, name in names.items() if class_id}
    best = {one: max(exact, key=lambda view: int((exact[view] == one).sum())) for one in objects}
    found = []
    for one, name in objects.items():
        entries = []
        for view in sorted(set(best.values()) if boxes else {best[one]}):
            entry: dict[str, Any] = {"view": view}
            rows, columns = np.nonzero(exact[view] == one)
            if boxes and len(rows):
                entry["box"] = [int(v) for v in (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)]
            if view == best[one]:
                on, beside = placed(exact[view], one)
                entry["points"] = [[column, row] for row, column in on]
                entry["outside"] = [[column, row] for row, column in beside]
            if len(entry) > 1:
                entries.append(entry)
        found.append({"name": name, "id": one, "prompts": entries})
    return {"objects": found}, set(best.values())


def overlap(
    folder: Path, exact: dict[str, np.ndarray], objects: Sequence[int], prompted: set[str], as_one: bool
) -> float:
    """Return the mean over objects of the mean IoU, in per cent, of the masks in ``folder``/masks."""
    by_object: dict[int, list[float]] = {one: [] for one in ([1] if as_one else objects)}
    for view, truth in exact.items():
        path = folder / "masks" / f"{view}.png"
        if view in prompted or not path.exists():
            continue
        drawn, known = read_id_mask(path), truth != IGNORED
        for one, values in by_object.items():
            mine, its = (drawn != 0, truth != 0) if as_one else (drawn == one, truth == one)
            if (its & known).any():
                values.append(100 * float((mine & its & known).sum() / ((mine | its) & known).sum()))
    return float(np.mean([np.mean(values) for values in by_object.values() if values]))


def refined(base: Path, data: Path, masks: Path, folder: Path, preset: str) -> str:
    """Refine the base with other masks by a preset; return the extracted BIoU, mean and worst object's, as text.

    folder: of the runs with these masks; each preset has its own below it.
    """
    from beags_plugin.objects.evaluate import evaluate_run
    from beags_plugin.plugin.launch import train
    from beags_plugin.plugin.presets import preset_config
    from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig

    run = folder / preset
    if not (run / "config.yml").exists():
        config = preset_config(preset, {"pipeline.model.base_steps": 0}, Path("benchmarks"))
        config.run_dir, config.vis, config.load_dir = run, "tensorboard", base / "nerfstudio_models"
        config.steps_per_eval_image = 0
        config.data_config.dataparser = BeagsDataParserConfig(data=data, masks_path=masks)
        train(config)
    found = evaluate_run(run / "config.yml").to_json()
    worst = found["objects"][found["worst"]]["extracted"]["after"]["biou"]
    return f"{100 * found['mean']['extracted']['after']['biou']:.1f}, {100 * worst:.1f}"


def compare(config_path: Path, output: Path, sources: Sequence[str], preset: str | None, snap: int = 0) -> None:
    """Print the rows of one base; preset: refines with the masks of each source and the exact ones; None: nothing.

    snap: pixels; see ``make_masks``.
    """
    from beags_plugin.objects.make_masks import configured_source, make_masks
    from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
    from beags_plugin.runs.relocation import open_run
    from beags_plugin.system.errors import UserError

    data = Path(open_run(config_path).data_path)
    parser = BeagsDataParserConfig(data=data)
    parsed = parser.setup()
    _, views = parsed.posed_views()
    trained = [views.images[index].stem for index in parsed.views_of_split(views, "train")]
    exact = {view: read_id_mask(data / f"ground_truth/masks/{view}.png").astype(np.int32) for view in trained}
    names = read_classes(data / "classes.json")
    prompts, prompted = prompts_of(exact, names, boxes=False)
    objects = [entry["id"] for entry in prompts["objects"]]
    for source in (*sources, "exact"):
        name = f"{source}, snap {snap}" if snap and source != "exact" else source
        folder = output / data.name / name.replace(", snap ", "-snap-")
        folder.mkdir(parents=True, exist_ok=True)
        masks, quality = folder / "masks", "100"
        if source == "exact":
            masks = data / "ground_truth/masks"
        else:
            options = []
            if source != "salient":
                file = folder / "prompts.json"
                file.write_text(json.dumps(prompts_of(exact, names, boxes=source == "grabcut")[0]))
                options = [f"prompts={file.absolute()}"]
            try:
                make_masks(parser, configured_source(source, options), config_path, folder, overwrite=True, snap=snap)
            except UserError as error:
                print(f"{data.name}: {source}: {error}", file=sys.stderr)
                continue
            quality = f"{overlap(folder, exact, objects, prompted, source == 'salient'):.1f}"
        after = "-"
        if preset is not None and source != "salient":
            after = refined(config_path.parent, data, masks, folder, preset)
        print(f"| {data.name} | {name} | {quality} | {after} |", flush=True)


def source_list(text: str) -> list[str]:
    """Return the sources of a list with commas; raises ``ArgumentTypeError`` for a name that is none."""
    names = text.split(",")
    if unknown := [name for name in names if name not in SOURCES]:
        raise argparse.ArgumentTypeError(f"no source {', '.join(map(repr, unknown))}: choose from {', '.join(SOURCES)}")
    return names


def main(given: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--refine", action="store_true", help="refine with the masks of each source")
    parser.add_argument("--preset", default="beags-fast", choices=shipped_names("method_configs"), metavar="NAME")
    parser.add_argument("--sources", type=source_list, default=list(SOURCES), metavar="NAME,...")
    parser.add_argument("--snap", type=int, default=0, metavar="RADIUS", help="pixels, of the sources' outlines")
    parser.add_argument("output", type=Path)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="config.yml of a base")
    options = parser.parse_args(given)
    after = f"worst after {options.preset}" if options.refine else "worst after refinement"
    print(f"| scene | source | IoU of training masks | extracted BIoU, {after} |\n|---|---|---|---|")
    for config in options.runs:
        compare(config, options.output, options.sources, options.preset if options.refine else None, options.snap)


if __name__ == "__main__":
    main()
