"""Parsers of text: JSON, TOML and YAML."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from parser_targets.target import SIDE, Target, as_json, pictures


def _classes(path: Path) -> None:
    from beags_plugin.labels.classes import read_classes

    read_classes(path)


def _coco(path: Path) -> None:
    from beags_plugin.masks.sources.base import Photo, SourceScene
    from beags_plugin.masks.sources.coco import CocoSource

    photos = [Photo(file.stem, file, SIDE, SIDE) for file in sorted(pictures().iterdir())]
    made = CocoSource(file=path).make(SourceScene(path.parent, photos), lambda done, total: None)
    for class_map in made.maps:
        assert class_map is None or class_map.shape == (SIDE, SIDE)


def _prompts(path: Path) -> None:
    from beags_plugin.masks.sources.prompts import read_prompts

    read_prompts(path)


def _experiment(path: Path) -> None:
    from beags_benchmarks.experiments.experiment import load_experiment

    load_experiment(str(path))


def _config(path: Path) -> None:
    from beags_plugin.plugin.options.saved_config import load_run_config

    load_run_config(path)


def _coco_files() -> list[bytes]:
    from pycocotools import mask

    packed = mask.encode(np.asfortranarray(np.eye(SIDE, dtype=np.uint8)))
    segmentations = [
        {"size": [SIDE, SIDE], "counts": packed["counts"].decode()},
        {"size": [SIDE, SIDE], "counts": [6, 10, 20]},
        [[1, 1, 4, 1, 4, 4]],
    ]
    return [
        as_json({
            "images": [{"id": 1, "file_name": "a.png"}],
            "categories": [{"id": 1, "name": "cup"}],
            "annotations": [{"image_id": 1, "category_id": 1, "segmentation": one}],
        })
        for one in segmentations
    ]  # fmt: skip


def _prompt_files() -> list[bytes]:
    prompt = {"view": "a", "box": [1, 1, 4, 4], "points": [[2, 2]], "outside": [[0, 0]]}
    return [as_json({"objects": [{"name": "cup", "id": 3, "text": "a cup", "prompts": [prompt]}]})]


def _experiment_files() -> list[bytes]:
    own = b'description = "x"\npreset = "beags-tiny"\nseeds = [1]\n[[variant]]\nname = "a"\n[[variant]]\nname = "b"\n'
    sweep = b'[[sweep]]\nname = "s"\nkey = "pipeline.model.prepare.k"\nvalues = [1, 2]\nlines = { "x" = {} }\n'
    sample = b'[sample]\nseeds = [0]\nwidth = 32\n[paper]\nsource = "p"\ncolumns = ["c"]\nrows = { "a" = [[1, 2]] }\n'
    return [own + b'refine = { "pipeline.model.prepare.k" = 3 }\n', own.partition(b"[[")[0] + sample + sweep]


def _config_files() -> list[bytes]:
    import yaml

    from beags_plugin.plugin.options.config import base_config

    text = yaml.dump(base_config())
    short = "!!python/object:beags_plugin.options.stages.DensifyConfig\nevery: 100\nstart: 500\n"
    return [text.encode(), short.encode(), b"a: !!python/object/apply:pathlib.PosixPath [a, b]\n"]


TARGETS = {
    "classes.json": Target("classes.json", _classes, lambda: [as_json({"1": "cup", "2": "box"}), b"{}"]),
    "coco": Target("annotations.json", _coco, _coco_files),
    "prompts": Target("prompts.json", _prompts, _prompt_files),
    "experiment": Target("mine.toml", _experiment, _experiment_files),
    "run config": Target("config.yml", _config, _config_files),
}
