"""Masks and names of classes that cannot be used."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from data_folders import HEIGHT, WIDTH, noise, write_image
from PIL import Image

from mistakes.table import Place, mistake


def mask(change: Callable[[Path], Any], *flags: str) -> Callable[[Place], Any]:
    """A mistake in one mask."""

    def make(at: Place):
        change(at.data / "masks/v01.png")
        return at.train(*flags)

    return make


def ids(value: int, dtype: type = np.uint8) -> np.ndarray:
    found = np.zeros((HEIGHT, WIDTH), dtype)
    found[2:5, 3:8] = value
    return found


mistake("masks", "another size than the photo")(mask(lambda path: write_image(path, noise(0, 4, 3)[..., 0])))
mistake("masks", "colours instead of ids")(mask(lambda path: write_image(path, noise(0))))
mistake("masks", "an id that classes.json does not name")(mask(lambda path: write_image(path, ids(7))))
mistake("masks", "cut off")(mask(lambda path: path.write_bytes(path.read_bytes()[:-30])))
mistake("masks", "no bytes")(mask(lambda path: path.write_bytes(b"")))
mistake("masks", "a JPEG called .png")(mask(lambda path: Image.fromarray(ids(2)).save(path, format="JPEG")))
mistake("masks", "ids above 65,535")(mask(lambda path: Image.fromarray(ids(70_000, np.int32)).save(path, "TIFF")))


@mistake("masks", "none of a photo's name")
def _(at: Place):
    for path in list((at.data / "masks").iterdir()):
        path.rename(path.with_name(f"mask_{path.name}"))
    return at.train()


@mistake("masks", "none at all")
def _(at: Place):
    for path in list((at.data / "masks").iterdir()):
        path.unlink()
    return at.train()


@mistake("masks", "a folder that does not exist")
def _(at: Place):
    return at.train("beags-data", "--masks-path", "mask")


@mistake("masks", "background alone")
def _(at: Place):
    for path in list((at.data / "masks").iterdir()):
        write_image(path, ids(0))
    return at.train("--pipeline.model.base-steps", "2", "--pipeline.model.refine-steps", "2")


def classes(text: str | bytes) -> Callable[[Place], Any]:
    def make(at: Place):
        path = at.data / "classes.json"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return at.train()

    return make


def named(names: Any) -> Callable[[Place], Any]:
    return classes(json.dumps(names))


mistake("classes.json", "broken")(classes('{"1": "cup"'))
mistake("classes.json", "empty")(classes(""))
mistake("classes.json", "not UTF-8")(classes(b'{"1": "\xff"}'))
mistake("classes.json", "a list")(named(["cup", "box"]))
mistake("classes.json", "a negative id")(named({"-1": "cup", "2": "box"}))
mistake("classes.json", "two classes of one name")(named({"1": "cup", "2": "cup"}))
mistake("classes.json", "an id named twice")(classes('{"1": "cup", "1": "box"}'))
mistake("classes.json", "an empty name")(named({"1": "  ", "2": "box"}))
mistake("classes.json", "a line break in a name")(named({"1": "cup\nbox", "2": "box"}))


@mistake("classes.json", "a folder")
def _(at: Place):
    (at.data / "classes.json").unlink()
    (at.data / "classes.json").mkdir()
    return at.train()


def made(source: str, prepare: Callable[[Path], Any] = lambda data: None, options: str = "") -> Callable[[Place], Any]:
    """A mistake in what ``beags masks make`` reads."""

    def make(at: Place):
        prepare(at.data)
        words = f"--options {options}" if options else ""
        return at.beags("masks make --data", at.data, f"--source {source} --overwrite {words}")

    return make


def coco(segmentation: Any, **entries: Any) -> Callable[[Path], Any]:
    content = {
        "images": [{"id": 1, "file_name": "v01.png"}],
        "annotations": [{"image_id": 1, "category_id": 1, "segmentation": segmentation}],
        **entries,
    }
    return lambda data: (data / "annotations.json").write_text(json.dumps(content))


def rle(height: int, width: int, counts: Any) -> Callable[[Path], Any]:
    return coco({"size": [height, width], "counts": counts})


mistake("mask sources", "an unknown option")(made("coco", options="color=red"))
mistake("mask sources", "a wrong value of an option")(made("langsplat", options="similarity=much"))
mistake("mask sources", "COCO: no such file")(made("coco"))
mistake("mask sources", "COCO: broken")(made("coco", lambda data: (data / "annotations.json").write_text("{")))
mistake("mask sources", "COCO: no annotations")(
    made("coco", lambda data: (data / "annotations.json").write_text('{"images": []}'))
)
mistake("mask sources", "COCO: of other photos")(
    made("coco", coco([[1, 1, 5, 1, 5, 5]], images=[{"id": 1, "file_name": "other.png"}]))
)
mistake("mask sources", "COCO: run lengths of another size")(made("coco", rle(10, 20, [200])))
mistake("mask sources", "COCO: packed run lengths that overflow")(made("coco", rle(HEIGHT, WIDTH, "o" * 40)))
mistake("mask sources", "a folder without masks")(made("id-images", options="folder=nowhere"))
mistake("mask sources", "Gaussian Grouping without its folder")(made("gaussian-grouping"))
mistake("mask sources", "images of objects missing")(made("object-images"))
mistake("mask sources", "LangSplat without its folder")(made("langsplat"))


def langsplat(segments: Any, features: Any) -> Callable[[Path], Any]:
    def write(data: Path) -> None:
        folder = data / "language_features"
        folder.mkdir()
        for name, array in (("v01_s.npy", segments), ("v01_f.npy", features)):
            if isinstance(array, bytes):
                (folder / name).write_bytes(array)
            else:
                np.save(folder / name, array)

    return write


mistake("mask sources", "LangSplat: pickled objects")(
    made("langsplat", langsplat(np.array([{}], dtype=object), np.ones((1, 3))))
)
mistake("mask sources", "LangSplat: an array cut off")(made("langsplat", langsplat(b"\x93NUMPY\x01", np.ones((1, 3)))))
mistake("mask sources", "LangSplat: segments of wrong shape")(made("langsplat", langsplat(np.ones(3), np.ones((1, 3)))))
mistake("mask sources", "LangSplat: segments without features")(
    made("langsplat", langsplat(np.full((4, HEIGHT, WIDTH), 5), np.ones((1, 3))))
)


def prompts(content: Any) -> Callable[[Path], Any]:
    text = content if isinstance(content, str) else json.dumps({"objects": [content]})
    return lambda data: (data / "prompts.json").write_text(text)


def boxed(box: list[Any], view: str = "v01") -> dict[str, Any]:
    return {"name": "cup", "prompts": [{"view": view, "box": box}]}


def grabcut(prepare: Callable[[Path], Any] = lambda data: None) -> Callable[[Place], Any]:
    """A mistake in the prompts of GrabCut, which asks a run for its depth."""

    def make(at: Place):
        prepare(at.data)
        words = "--source grabcut --overwrite --options prompts=prompts.json --load-config {run}"
        return at.beags("masks make --data", at.data, words)

    return make


mistake("mask sources", "GrabCut: no prompts")(grabcut())
mistake("mask sources", "GrabCut: a box outside of the picture")(grabcut(prompts(boxed([100, 100, 200, 200]))))
mistake("mask sources", "GrabCut: a box turned around")(grabcut(prompts(boxed([8, 8, 2, 2]))))
mistake("mask sources", "GrabCut: a view that does not exist")(grabcut(prompts(boxed([2, 2, 8, 8], "v99"))))
mistake("mask sources", "GrabCut: prompts broken")(grabcut(prompts("{")))
mistake("mask sources", "GrabCut: prompts nested 100,000 deep")(grabcut(prompts("[" * 100_000)))


@mistake("mask sources", "SAM2 without weights")
def _(at: Place):
    import sys
    from types import SimpleNamespace

    from beags_plugin.masks.sources import sam2

    def absent(name, **_):
        raise OSError(f"{name} is not a local folder and is not a valid model identifier")

    prompts(boxed([2, 2, 8, 8]))(at.data)
    library = SimpleNamespace(Sam2VideoModel=SimpleNamespace(from_pretrained=absent))  # which is installed on demand
    at.patch.setitem(sys.modules, "transformers", library)
    at.patch.setattr(sam2.Sam2Source, "unavailable", classmethod(lambda cls: None))
    words = "--source sam2 --overwrite --options prompts=prompts.json model=nowhere"
    return at.beags("masks make --data", at.data, words)


@mistake("mask sources", "SAM2 without its extra")
def _(at: Place):
    from beags_plugin.masks.sources import sam2

    at.patch.setattr(sam2, "find_spec", lambda name: None)
    return at.beags("masks make --data", at.data, "--source sam2 --overwrite")


@mistake("mask sources", "depth of a run without the run")
def _(at: Place):
    prompts(boxed([2, 2, 8, 8]))(at.data)
    return at.beags("masks make --data", at.data, "--source grabcut --overwrite --options prompts=prompts.json")
