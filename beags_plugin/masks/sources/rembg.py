"""Source without prompts: a network of the library rembg, by its name, finds what stands out in each photo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import ClassVar

import numpy as np

from beags_plugin.masks.sources.base import MadeMasks, MaskSource, Progress, SourceScene
from beags_plugin.masks.sources.salient import one_object, weights_folder
from beags_plugin.system.errors import UserError, check_choice

# The library's models that need more than a photo: prompts, weights of one's own, a service that photos are sent to,
# or that find something else.
OTHERS = ("sam", "u2net_custom", "dis_custom", "ben_custom", "withoutbg", "atlascloud", "u2net_cloth_seg")


@dataclass(frozen=True)
class RembgSource(MaskSource):
    """A network of rembg cuts out what stands out in each training photo, as one object.

    model: as rembg calls it, such as isnet-general-use or birefnet-general; rembg fetches its weights. name: of the
    object.
    """

    guesses: ClassVar[bool] = True

    model: str = "isnet-general-use"
    name: str = "object"

    @classmethod
    def unavailable(cls) -> str | None:
        if find_spec("rembg") is None:
            return "the library rembg is not installed: pip install rembg 'numpy<2'."  # its newest want numpy 2
        return None

    def check(self) -> None:
        load(self.model)

    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        return one_object(scene, self.name, load(self.model), progress)


def load(model: str) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from photos [H, W, 3] uint8 RGB to what a model of rembg says, [H, W] float32 in 0..1.

    Raises ``UserError`` for an unknown model, and where its weights cannot be had.
    """
    try:
        rembg, sessions = import_module("rembg"), import_module("rembg.sessions")
    except (ImportError, SystemExit) as error:  # It ends the process where it finds no onnxruntime.
        raise UserError(
            f"the library rembg cannot be imported ({error}): pip install rembg onnxruntime 'numpy<2'."
        ) from error
    check_choice(model, sorted(set(sessions.sessions_names) - set(OTHERS)), "model", " of rembg for photos alone")
    try:
        session = rembg.new_session(model)
    except Exception as error:  # those of its downloads and of onnxruntime have no class in common
        raise UserError(
            f"rembg cannot fetch the weights of {model}, or load them ({type(error).__name__}): go online once, or put "
            f"them at {weights_folder() / f'{model}.onnx'}."
        ) from error

    def saliency(photo: np.ndarray) -> np.ndarray:
        return np.asarray(rembg.remove(photo, session=session, only_mask=True), dtype=np.float32) / 255.0

    return saliency
