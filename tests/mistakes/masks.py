"""Masks and names of classes that cannot be used."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from data_folders import HEIGHT, WIDTH, noise, write_image
from PIL import Image
from weights import onnx_model

from mistakes.table import Place, beags_after, mistakes, train_after


def mask(change: Callable[[Path], Any]) -> Callable[[Place], Any]:
    """Return a mistake in one mask."""
    return before_training(lambda at: change(at.data / "masks/v01.png"))


def every_mask(change: Callable[[Path], Any], but: Sequence[str] = ()) -> Callable[[Place], Any]:
    """Return a mistake in every mask but those of some views."""
    return before_training(
        lambda at: [change(path) for path in list((at.data / "masks").iterdir()) if path.stem not in but]
    )


def before_training(change: Callable[[Place], Any]) -> Callable[[Place], Any]:
    """Return a mistake that ns-train meets before its first step."""

    def change_and_watch(at: Place) -> None:
        from beags_plugin.plugin.trainer import BeagsTrainer

        change(at)
        at.patch.setattr(BeagsTrainer, "train_iteration", lambda *_: pytest.fail("a step was trained"))

    return train_after(change_and_watch)


def ids(value: int, dtype: type = np.uint8) -> np.ndarray:
    found = np.zeros((HEIGHT, WIDTH), dtype)
    found[2:5, 3:8] = value
    return found


mistakes(
    "masks",
    {
        "another size than the photo": mask(lambda path: write_image(path, noise(0, 4, 3)[..., 0])),
        "colours instead of ids": mask(lambda path: write_image(path, noise(0))),
        "an id that classes.json does not name": mask(lambda path: write_image(path, ids(7))),
        "cut off": mask(lambda path: path.write_bytes(path.read_bytes()[:-30])),
        "no bytes": mask(lambda path: path.write_bytes(b"")),
        "a JPEG called .png": mask(lambda path: Image.fromarray(ids(2)).save(path, format="JPEG")),
        "ids above 65,535": mask(lambda path: Image.fromarray(ids(70_000, np.int32)).save(path, "TIFF")),
        "none of a photo's name": every_mask(lambda path: path.rename(path.with_name(f"mask_{path.name}"))),
        "none at all": every_mask(lambda path: path.unlink()),
        "a folder that does not exist": lambda at: at.train("beags-data", "--masks-path", "mask"),
        "none but of held-out views": every_mask(lambda path: path.unlink(), but=("v00", "v08")),
        "background alone": every_mask(lambda path: write_image(path, ids(0)), but=("v00", "v08")),
    },
)


def classes(content: Any) -> Callable[[Place], Any]:
    """Return a mistake in classes.json. content: bytes, text, or names as JSON."""
    text = content if isinstance(content, (str, bytes)) else json.dumps(content)
    return train_after(
        lambda at: (at.data / "classes.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    )


def folder_for_classes(at: Place) -> None:
    (at.data / "classes.json").unlink()
    (at.data / "classes.json").mkdir()


mistakes(
    "classes.json",
    {
        "broken": classes('{"1": "cup"'),
        "empty": classes(""),
        "not UTF-8": classes(b'{"1": "\xff"}'),
        "a list": classes(["cup", "box"]),
        "a negative id": classes({"-1": "cup", "2": "box"}),
        "two classes of one name": classes({"1": "cup", "2": "cup"}),
        "an id named twice": classes('{"1": "cup", "1": "box"}'),
        "an empty name": classes({"1": "  ", "2": "box"}),
        "a line break in a name": classes({"1": "cup\nbox", "2": "box"}),
        "a folder": train_after(folder_for_classes),
    },
)


def made(source: str, prepare: Callable[[Path], Any] = lambda data: None, options: str = "") -> Callable[[Place], Any]:
    """Return a mistake in the files that ``beags masks make`` reads."""
    words = f"masks make --data {{data}} --source {source} --overwrite {options}"
    return beags_after(lambda at: prepare(at.data), words)


def coco(segmentation: Any, **entries: Any) -> Callable[[Path], Any]:
    content = {
        "images": [{"id": 1, "file_name": "v01.png"}],
        "annotations": [{"image_id": 1, "category_id": 1, "segmentation": segmentation}],
        **entries,
    }
    return lambda data: (data / "annotations.json").write_text(json.dumps(content))


def file(name: str, text: str) -> Callable[[Path], Any]:
    return lambda data: (data / name).write_text(text)


def prompts(content: Any) -> Callable[[Place], Any]:
    """Return a mistake in the prompts of the cut, which asks a run for its Gaussians. content: text, or an object."""
    text = content if isinstance(content, str) else json.dumps({"objects": [content]})
    return made("cut", file("prompts.json", text), "--options prompts=prompts.json --load-config {run}")


def cut(**places: Any) -> Callable[[Place], Any]:
    """Return a mistake in the prompts of a cup, of which view v01 has these places."""
    return prompts({"name": "cup", "prompts": [{"view": "v01", **places}]})


CUP = {"name": "cup", "prompts": [{"view": "v01", "points": [[5, 5]]}]}
GOOD = file("prompts.json", json.dumps({"objects": [CUP]}))
OTHER_PHOTO = [{"id": 1, "file_name": "other.png"}]
mistakes(
    "mask sources",
    {
        "an unknown option": made("coco", options="--options color=red"),
        "a wrong value of an option": made("id-images", options="--options least_views=much"),
        "COCO: no such file": made("coco"),
        "COCO: broken": made("coco", file("annotations.json", "{")),
        "COCO: no annotations": made("coco", file("annotations.json", '{"images": []}')),
        "COCO: of other photos": made("coco", coco([[1, 1, 5, 1, 5, 5]], images=OTHER_PHOTO)),
        "COCO: run lengths of another size": made("coco", coco({"size": [10, 20], "counts": [200]})),
        "COCO: packed run lengths that overflow": made("coco", coco({"size": [HEIGHT, WIDTH], "counts": "o" * 40})),
        "a folder without masks": made("id-images", options="--options folder=nowhere"),
        "Gaussian Grouping without its folder": made("gaussian-grouping"),
        "images of objects missing": made("object-images"),
        "the cut: no prompts": made("cut", options="--options prompts=prompts.json --load-config {run}"),
        "the cut: a box outside of the picture": cut(points=[[5, 5]], box=[100, 100, 200, 200]),
        "the cut: a box turned around": cut(box=[8, 8, 2, 2]),
        "the cut: prompts broken": prompts("{"),
        "the cut: prompts nested 100,000 deep": prompts("[" * 100_000),
        "the cut: no point on the object": cut(box=[2, 2, 8, 8]),
        "the cut: a point outside of the picture": cut(points=[[100, 100]]),
        "the cut: a view that does not exist": cut(view="v99", points=[[5, 5]]),
        "the cut: points that contradict": cut(points=[[6, 6]], outside=[[6, 6]]),
        "the cut: a point on nothing": cut(points=[[0, 11]]),
        "the cut without a run": made("cut", GOOD, "--options prompts=prompts.json"),
    },
)


def sam2(model_type: str, options: str = "", old: bool = False) -> Callable[[Place], Any]:
    """Return a mistake in the weights of the SAM source, one folder of which is of a type; old: the library."""

    def write(data: Path) -> None:
        text = {"objects": [{"name": "cup", "text": "a cup"}]}
        (data / "prompts.json").write_text(json.dumps(text))
        for name, kind in (("sam2", "sam2_video"), ("other", model_type)):
            (data.parent / name).mkdir()
            (data.parent / name / "config.json").write_text(json.dumps({"model_type": kind}))

    def make(at: Place):
        from beags_plugin.masks.sources.sam2 import TRACKERS

        library = pytest.importorskip("transformers", reason="the extra [sam2] (transformers) is not installed")
        if old:
            at.patch.setitem(TRACKERS, "sam3_video", ("Sam3ModelToCome", "Sam3ProcessorToCome"))
            at.patch.setattr(library, "__version__", "4.57.1")
        return made("sam2", write, f"--options prompts=prompts.json local=true {options or 'model=other'}")(at)

    return make


mistakes(
    "mask sources",
    {
        "SAM: a folder of weights that is not there": sam2("", "model=/none/such/weights"),
        "SAM: weights of another model": sam2("bert"),
        "SAM: a detector that takes no texts": sam2("sam2_video", "model=sam2 detector=other"),
        "SAM: a library too old": sam2("sam3_video", old=True),
    },
)


def without_extra(source: str) -> Callable[[Place], Any]:
    def make(at: Place):
        at.patch.setattr(f"beags_plugin.masks.sources.{source}.find_spec", lambda name: None)
        return made(source)(at)

    return make


def salient(weights: bytes | None, path: str = "../home/u2netp.onnx", model: str = "u2netp") -> Callable[[Place], Any]:
    """Return a mistake in the weights of the salient source, whose home is beside the data."""

    def write(data: Path) -> None:
        if weights is not None:
            (data / path).parent.mkdir(exist_ok=True)
            (data / path).write_bytes(weights)

    def make(at: Place):
        pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
        at.patch.setenv("U2NET_HOME", str(at.root / "home"))
        return made("salient", write, f"--options model={model}")(at)

    return make


mistakes(
    "mask sources",
    {
        "SAM without its extra": without_extra("sam2"),
        "rembg without the library": without_extra("rembg"),
        "salient without its extra": without_extra("salient"),
        "salient without weights": salient(None),
        "salient: weights that rembg knows but that are not there": salient(None, model="u2net"),
        "salient: damaged weights": salient(b"\x08\x06"),
        "salient: a file that is no network": salient(b"no", "../home/u2net.onnx", "u2net"),
        "salient: a network of another kind": salient(onnx_model([1, 3, 8, 8], [1, 3, 8, 8]), "a.onnx", "a.onnx"),
    },
)
