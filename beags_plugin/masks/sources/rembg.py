"""Source of masks without prompts: a salient-object network of the library rembg."""

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

# Models of the library that need more than a photo (prompts, the user's own weights, an online service), or that find
# something else.
OTHERS = ("sam", "u2net_custom", "dis_custom", "ben_custom", "withoutbg", "atlascloud", "u2net_cloth_seg")


@dataclass(frozen=True)
class RembgSource(MaskSource):
    """What a network of rembg finds salient in each training photo, as one object.

    model: rembg's name, such as isnet-general-use or birefnet-general; rembg fetches its weights. name: of the object.
    """

    guesses: ClassVar[bool] = True

    model: str = "isnet-general-use"
    name: str = "object"

    @classmethod
    def unavailable(cls) -> str | None:
        if find_spec("rembg") is None:
            return "the library rembg is not installed: pip install rembg 'numpy<2'."  # the newest versions need it
        return None

    def check(self) -> None:
        load(self.model)

    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        return one_object(scene, self.name, load(self.model), progress)


def load(model: str) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from photos [H, W, 3] uint8 RGB to a model's saliency, [H, W] float32 in 0..1.

    Raises ``UserError`` for an unknown model, and if its weights are not available.
    """
    try:
        rembg, sessions = import_module("rembg"), import_module("rembg.sessions")
    except (ImportError, SystemExit) as error:  # rembg ends the process if onnxruntime is missing
        raise UserError(
            f"the library rembg cannot be imported ({error}): pip install rembg onnxruntime 'numpy<2'."
        ) from error
    check_choice(model, sorted(set(sessions.sessions_names) - set(OTHERS)), "model", " of rembg for photos alone")
    try:
        session = rembg.new_session(model)
    except Exception as error:  # errors of its downloads and of onnxruntime have no class in common
        raise UserError(
            f"rembg cannot fetch the weights of {model}, or load them ({type(error).__name__}): go online once, or put "
            f"them at {weights_folder() / f'{model}.onnx'}."
        ) from error

    def saliency(photo: np.ndarray) -> np.ndarray:
        return np.asarray(rembg.remove(photo, session=session, only_mask=True), dtype=np.float32) / 255.0

    return saliency
