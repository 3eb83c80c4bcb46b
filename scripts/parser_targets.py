"""What reads files of strangers, as functions of bytes, with small valid files to begin with: for ``fuzz_parsers``."""

from __future__ import annotations

import io
import json
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from beags_plugin.core.surfels import Surfels
from beags_plugin.errors import UserError

SIDE = 6  # pixels of the pictures
FOLDER = Path("/dev/shm") if Path("/dev/shm").is_dir() else Path(tempfile.gettempdir())


@dataclass(frozen=True)
class Target:
    """One parser. read: is given the file. seeds: valid files. wrap: makes a file of the bytes that are changed."""

    file: str
    read: Callable[[Path], Any]
    seeds: Callable[[], list[bytes]]
    wrap: Callable[[bytes], bytes] = lambda content: content


@lru_cache(None)
def folder() -> Path:
    """Where the files of this process go."""
    return Path(tempfile.mkdtemp(prefix="beags-fuzz-", dir=FOLDER))


def examine(target: Target, content: bytes) -> str | None:
    """What the parser says of a file: None if it is taken, else its sentence; anything but that raises."""
    path = folder() / target.file
    path.write_bytes(target.wrap(content))
    try:
        with redirect_stdout(io.StringIO()):
            target.read(path)
    except UserError as error:
        sentence = str(error)
        if "\n" in sentence or len(sentence) > 2000:
            raise AssertionError(f"not one sentence: {sentence[:300]!r}") from error
        return sentence
    return None


# -- parsers ---------------------------------------------------------------------------------------------------------


def _splats(path: Path) -> None:
    from beags_plugin.core.flattening import flatten
    from beags_plugin.extraction.splat_file import read_splat_file

    gaussians = read_splat_file(path).gaussians
    usable = gaussians.usable()
    if bool(usable.any()):
        flatten(gaussians[usable])


def _points(path: Path) -> None:
    from beags_plugin.plugin.seed_points import read_ply_points

    read_ply_points(path)


@lru_cache(None)
def _pictures() -> Path:
    """A folder of three pictures."""
    images = folder() / "images"
    images.mkdir()
    for name in "abc":
        Image.fromarray(np.zeros((SIDE, SIDE, 3), np.uint8)).save(images / f"{name}.png")
    return images


def _poses_bounds(path: Path) -> None:
    from beags_plugin.data.poses_bounds import read_poses_bounds

    read_poses_bounds(path, _pictures())


def _dtu(path: Path) -> None:
    from beags_plugin.data.layouts.dtu import read_cameras

    read_cameras(path, sorted(_pictures().iterdir()))


def _colmap(path: Path) -> None:
    from nerfstudio.data.utils import colmap_parsing_utils as colmap

    from beags_plugin.plugin.colmap_files import _read

    kind = path.name.split(".")[0]
    _read(getattr(colmap, f"read_{kind}_binary"), path)


def _transforms(path: Path) -> None:
    from beags_plugin.data.scene import TransformsFile
    from beags_plugin.plugin.cameras import check_cameras
    from beags_plugin.plugin.poses import Normalization, read_poses

    _pictures()
    views = read_poses(TransformsFile(path), path.parent, Normalization("up", "poses", True, 1.0, 1.0))
    check_cameras(views.cameras, views.images)


def _classes(path: Path) -> None:
    from beags_plugin.masks.classes import read_classes

    read_classes(path)


def _coco(path: Path) -> None:
    from beags_plugin.masks.sources.base import Photo, SourceScene
    from beags_plugin.masks.sources.coco import CocoSource

    photos = [Photo(file.stem, file, SIDE, SIDE) for file in sorted(_pictures().iterdir())]
    made = CocoSource(file=path).make(SourceScene(path.parent, photos), lambda done, total: None)
    for class_map in made.maps:
        assert class_map is None or class_map.shape == (SIDE, SIDE)


def _prompts(path: Path) -> None:
    from beags_plugin.masks.sources.prompts import read_prompts

    read_prompts(path)


def _experiment(path: Path) -> None:
    from beags_plugin.bench.experiment import load_experiment

    load_experiment(str(path))


def _checkpoint(path: Path) -> None:
    from beags_plugin.importers.checkpoint import _gaussians
    from beags_plugin.plugin.saved_state import check_state
    from beags_plugin.plugin.training_state import read_checkpoint, training_state

    try:
        state = read_checkpoint(path)
        check_state({k.removeprefix("_model."): v for k, v in state["pipeline"].items() if isinstance(k, str)}, path)
        training_state(state, path)
    except UserError:
        _gaussians(path)
        raise


def _grid(path: Path) -> None:
    from beags_plugin.plugin.prepared_grid import read_grid

    read_grid(path)


def _filed(path: Path) -> None:
    from beags_plugin.core.filed_tensors import FiledTensors

    try:
        list(FiledTensors(path))
    except (OSError, ValueError, EOFError):  # what the store of stages takes for a damaged file
        return


def _mask(path: Path) -> None:
    from beags_plugin.masks.classes import read_binary_mask, read_class_map

    try:
        read_class_map(path, (255,))
    except UserError:
        read_binary_mask(path)


def _config(path: Path) -> None:
    from beags_plugin.plugin.run_config import load_run_config

    load_run_config(path)


# -- valid files -----------------------------------------------------------------------------------------------------


def _ply_files() -> list[bytes]:
    from beags_plugin.extraction.ply import write_ply

    surfels = Surfels(
        torch.zeros(2, 3), torch.ones(2, 4), torch.zeros(2, 2), torch.zeros(2), torch.zeros(2, 3), torch.zeros(2, 3, 3)
    )
    write_ply(folder() / "seed.ply", surfels, torch.tensor([0, 1], dtype=torch.int32))
    binary = (folder() / "seed.ply").read_bytes()
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2"]
    columns = "".join(f"property float {name}\n" for name in [*names, "rot_3"])
    text = f"ply\nformat ascii 1.0\nelement vertex 1\n{columns}end_header\n" + "1 " * 13 + "\n"
    faces = b"ply\nformat binary_big_endian 1.0\nelement vertex 1\nproperty double x\nproperty double y\n"
    faces += b"property double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n"
    faces += b"property list uchar int vertex_indices\nend_header\n" + bytes(27) + b"\3" + bytes(12)
    return [binary, text.encode(), faces]


def _npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def _bounds_files() -> list[bytes]:
    row = np.concatenate([np.c_[np.eye(3), np.zeros(3), [SIDE, SIDE, 5.0]].ravel(), [1.0, 4.0]])
    return [_npy(np.stack([row] * 3)), _npy(np.stack([row] * 3).astype(np.float32))]


def _npz(arrays: dict[str, np.ndarray], packed: bool = False) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if packed else np.savez)(file, **arrays)
    return file.getvalue()


def _dtu_files() -> list[bytes]:
    matrix = np.array([[5.0, 0, 3, 0], [0, 5, 3, 0], [0, 0, 1, 2], [0, 0, 0, 1]])
    arrays = {f"world_mat_{index}": matrix for index in range(3)}
    return [_npz(arrays), _npz({**arrays, "scale_mat_0": np.eye(4)}, packed=True)]


@lru_cache(None)
def _good_dtu() -> bytes:
    return _dtu_files()[0]


def _as_member(content: bytes) -> bytes:
    """An archive for DTU, one of whose members is these bytes."""
    file = io.BytesIO(_good_dtu())
    file.seek(0, io.SEEK_END)
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr("scale_mat_1.npy", content)
    return file.getvalue()


def _image_files() -> list[bytes]:
    rest = (
        struct.pack("<i7di", 1, 1, 0, 0, 0, 0, 0, 0, 1)
        + b"a.png\0"
        + struct.pack("<Q", 1)
        + struct.pack("<2dq", 1, 1, 1)
    )
    return [struct.pack("<Q", 1) + rest, struct.pack("<Q", 0)]


def _camera_files() -> list[bytes]:
    return [struct.pack("<Q", 1) + struct.pack("<iiQQ4d", 1, 1, SIDE, SIDE, 5, 5, 3, 3)]


def _point_files() -> list[bytes]:
    return [struct.pack("<Q", 1) + struct.pack("<Q3d3BdQ", 1, 0, 0, 0, 1, 2, 3, 0.5, 1) + struct.pack("<ii", 1, 1)]


def _transforms_files() -> list[bytes]:
    poses = [np.c_[np.eye(4)[:, :3], [0.3 * index, 0.1, index, 1.0]].tolist() for index in range(3)]
    frames = [{"file_path": f"images/{name}.png", "transform_matrix": poses[i]} for i, name in enumerate("abc")]
    meta = {"fl_x": 5.0, "fl_y": 5.0, "cx": 3.0, "cy": 3.0, "w": SIDE, "h": SIDE, "camera_model": "OPENCV"}
    more = {"k1": 0.1, "train_filenames": ["images/a.png"], "val_filenames": ["images/b.png"], "applied_scale": 1.0}
    return [_json({**meta, "frames": frames}), _json({**meta, **more, "frames": [{**frames[0], **meta}, frames[1]]})]


def _json(content: Any) -> bytes:
    return json.dumps(content).encode()


def _coco_files() -> list[bytes]:
    from pycocotools import mask

    packed = mask.encode(np.asfortranarray(np.eye(SIDE, dtype=np.uint8)))
    segmentations = [
        {"size": [SIDE, SIDE], "counts": packed["counts"].decode()},
        {"size": [SIDE, SIDE], "counts": [6, 10, 20]},
        [[1, 1, 4, 1, 4, 4]],
    ]
    return [
        _json({
            "images": [{"id": 1, "file_name": "a.png"}],
            "categories": [{"id": 1, "name": "cup"}],
            "annotations": [{"image_id": 1, "category_id": 1, "segmentation": one}],
        })
        for one in segmentations
    ]  # fmt: skip


def _prompt_files() -> list[bytes]:
    prompt = {"view": "a", "box": [1, 1, 4, 4], "points": [[2, 2]], "outside": [[0, 0]]}
    return [_json({"objects": [{"name": "cup", "id": 3, "text": "a cup", "prompts": [prompt]}]})]


def _experiment_files() -> list[bytes]:
    own = b'description = "x"\npreset = "beags-tiny"\nseeds = [1]\n[[variant]]\nname = "a"\n[[variant]]\nname = "b"\n'
    sweep = b'[[sweep]]\nname = "s"\nkey = "pipeline.model.prepare.k"\nvalues = [1, 2]\nlines = { "x" = {} }\n'
    sample = b'[sample]\nseeds = [0]\nwidth = 32\n[paper]\nsource = "p"\ncolumns = ["c"]\nrows = { "a" = [[1, 2]] }\n'
    return [own + b'refine = { "pipeline.model.prepare.k" = 3 }\n', own.partition(b"[[")[0] + sample + sweep]


def _saved(content: Any) -> bytes:
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def _checkpoint_content() -> dict[str, Any]:
    shapes = {"means": (2, 3), "quats": (2, 4), "scales": (2, 2), "opacities": (2, 1), "features_dc": (2, 3)}
    state: dict[str, Any] = {f"_model.gauss_params.{name}": torch.ones(shape) for name, shape in shapes.items()}
    state["_model.gauss_params.features_rest"] = torch.zeros(2, 3, 3)
    state |= {"_model.class_ids": torch.zeros(2, dtype=torch.int32), "_model.class_margin": torch.ones(2)}
    state |= {"_model.assigned": torch.tensor(True), "_model.extent": torch.tensor(1.0)}
    state["_model._extra_state"] = {"classes": {0: "background"}}
    parts = {"views": {"sizes": [1, 1]}}
    return {"step": 3, "pipeline": state, "optimizers": {}, "scalers": {}, "beags": {"version": 1, "parts": parts}}


def _pickle_of(content: Any) -> bytes:
    with zipfile.ZipFile(io.BytesIO(_saved(content))) as archive:
        return archive.read(next(name for name in archive.namelist() if name.endswith("data.pkl")))


def _with_pickle(content: bytes) -> bytes:
    """A checkpoint whose list of contents is these bytes."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, member in _checkpoint_members().items():
            archive.writestr(name, content if name.endswith("data.pkl") else member)
    return file.getvalue()


@lru_cache(None)
def _checkpoint_members() -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(_saved(_checkpoint_content()))) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _grid_files() -> list[bytes]:
    state = {
        "voxel_size": torch.tensor(0.1, dtype=torch.float64),
        "origin": torch.zeros(3, dtype=torch.float64),
        "num_classes": torch.tensor(2),
        "keys": torch.arange(3),
        "classes": torch.zeros(3, dtype=torch.int32),
    }
    return [_saved(state), _saved({})]


def _filed_files() -> list[bytes]:
    from beags_plugin.core.filed_tensors import write_tensors

    file = io.BytesIO()
    write_tensors(file, [torch.ones(2, 2), torch.arange(3)])
    return [file.getvalue()]


def _png_files() -> list[bytes]:
    found = []
    for array, form in ((np.eye(SIDE), "PNG"), (300 * np.eye(SIDE), "PNG"), (np.ones((SIDE, SIDE, 3)), "BMP")):
        file = io.BytesIO()
        Image.fromarray(array.astype(np.uint16 if array.max() > 255 else np.uint8)).save(file, form)
        found.append(file.getvalue())
    for form in ("TIFF", "JPEG", "WEBP"):
        file = io.BytesIO()
        Image.fromarray(np.eye(SIDE, dtype=np.uint8)).save(file, form)
        found.append(file.getvalue())
    return found


def _as_png(content: bytes) -> bytes:
    """A PNG with the header that the first 13 bytes give and the rows that the rest give, its sums correct."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header, rows = content[:13].ljust(13, b"\0"), zlib.compress(content[13:])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def _png_rows() -> list[bytes]:
    return [struct.pack(">IIBBBBB", SIDE, SIDE, 8, 0, 0, 0, 0) + bytes(SIDE * (SIDE + 1))]


def _config_files() -> list[bytes]:
    import yaml

    from beags_plugin.plugin.config import base_config

    text = yaml.dump(base_config())
    short = "!!python/object:beags_plugin.core.densification.DensifyConfig\nevery: 100\nstart: 500\n"
    return [text.encode(), short.encode(), b"a: !!python/object/apply:pathlib.PosixPath [a, b]\n"]


TARGETS = {
    "ply": Target("a.ply", _splats, _ply_files),
    "seed points": Target("a.ply", _points, _ply_files),
    "npy poses": Target("poses_bounds.npy", _poses_bounds, _bounds_files),
    "npz cameras": Target("cameras_sphere.npz", _dtu, _dtu_files),
    "npz member": Target("cameras_sphere.npz", _dtu, lambda: [_npy(np.eye(4))], _as_member),
    "colmap images": Target("images.bin", _colmap, _image_files),
    "colmap cameras": Target("cameras.bin", _colmap, _camera_files),
    "colmap points": Target("points3D.bin", _colmap, _point_files),
    "transforms.json": Target("transforms.json", _transforms, _transforms_files),
    "classes.json": Target("classes.json", _classes, lambda: [_json({"1": "cup", "2": "box"}), b"{}"]),
    "coco": Target("annotations.json", _coco, _coco_files),
    "prompts": Target("prompts.json", _prompts, _prompt_files),
    "experiment": Target("mine.toml", _experiment, _experiment_files),
    "checkpoint": Target("step-000000003.ckpt", _checkpoint, lambda: [_saved(_checkpoint_content())]),
    "checkpoint pickle": Target(
        "step-000000003.ckpt", _checkpoint, lambda: [_pickle_of(_checkpoint_content())], _with_pickle
    ),
    "voxel grid": Target("grid.pt", _grid, _grid_files),
    "filed tensors": Target("a.npz", _filed, _filed_files),
    "mask": Target("a.png", _mask, _png_files),
    "mask rows": Target("a.png", _mask, _png_rows, _as_png),
    "run config": Target("config.yml", _config, _config_files),
}
"""By name."""
