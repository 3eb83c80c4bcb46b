"""Source by two-stage retrieval with SAM2's video model and Grounding DINO, from the library transformers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from beags_plugin.masks.sources.base import MadeMasks, MaskSource, Photo, Progress, SourceScene
from beags_plugin.masks.sources.prompts import Prompt, read_prompts
from beags_plugin.masks.sources.two_stage import BestLabels, Box, Retrieval, retrieve
from beags_plugin.system.errors import UserError

KEPT_FRAMES = 32  # of an object's memory about the tracked frame; the model uses 16 at most


@dataclass(frozen=True)
class Sam2Source(MaskSource):
    """SAM2 tracks objects through the training views in the order of names, from points, boxes, or texts for Grounding
    DINO. Held-out views are never seen: a mask that a program made of them is no truth.

    prompts: JSON, see ``prompts.read_prompts``. model, detector: a folder with the library's files, or a name on its
    hub; the detector is loaded only if an object has a text. device: "auto" prefers CUDA.
    threshold, strict, searched, retries: see ``two_stage.Retrieval``. local: never use the hub.
    """

    prompts: Path = Path("prompts.json")
    model: str = "facebook/sam2.1-hiera-small"
    detector: str = "IDEA-Research/grounding-dino-tiny"
    device: str = "auto"
    threshold: float = 0.3
    strict: float = 0.5
    searched: int = 8
    retries: int = 2
    local: bool = False

    @classmethod
    def unavailable(cls) -> str | None:
        if find_spec("transformers") is None:
            return "the library transformers is not installed: pip install beags[sam2]."
        return None

    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        path = scene.below(self.prompts)
        objects = read_prompts(path)
        trained = [index for index, photo in enumerate(scene.photos) if photo.trained]
        photos = [scene.photos[index] for index in trained]
        prompted = {view: scene.index_of(view, str(path)) for one in objects for view in one.prompts}
        if held_out := sorted(view for view, index in prompted.items() if index not in trained):
            raise UserError(f"{path} has prompts in {held_out[0]}, which is held out: prompt a training view.")
        frame_of = {view: trained.index(index) for view, index in prompted.items()}
        device = self.device
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        predictor = Sam2Predictor(*load(self.model, "Sam2VideoModel", self.local), photos, device)
        detector = None
        if any(one.text for one in objects):
            kind = "GroundingDinoForObjectDetection"
            detector = GroundingDino(*load(self.detector, kind, self.local), photos, device)
        names = {0: "background", **{one.class_id: one.name for one in objects}}
        options = Retrieval(self.threshold, self.strict, self.searched, self.retries)
        notes: list[str] = []

        def maps() -> Iterator[np.ndarray | None]:
            with TemporaryDirectory(prefix="beags-sam2-") as folder:
                best = BestLabels(Path(folder))
                names = [photo.name for photo in photos]
                notes.extend(retrieve(objects, frame_of, names, predictor, detector, best, options, progress))
                frames = iter(range(len(photos)))
                for photo in scene.photos:
                    yield best.labels(next(frames), (photo.height, photo.width)) if photo.trained else None

        return MadeMasks(names, maps(), notes)


def load(name: str, kind: str, local: bool = False) -> tuple[Any, Any]:
    """Load the model of class ``kind`` and its processor from a folder or the hub; raise ``UserError``."""
    import transformers  # pyright: ignore[reportMissingImports]

    if not (Path(name).is_dir() or re.fullmatch(r"[\w.-]+(/[\w.-]+)?", name)):
        raise UserError(f"there is no folder {name}: name one that holds the weights, or a model of the hub.")
    try:
        model = getattr(transformers, kind).from_pretrained(name, local_files_only=local)
        processor = transformers.AutoProcessor.from_pretrained(name, local_files_only=local)
    except (OSError, ValueError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise UserError(
            f"the weights {name} cannot be loaded ({reason}): name a folder that holds them, or go online once."
        ) from error
    return model.eval(), processor


class Sam2Predictor:
    """SAM2's video model as a ``two_stage.VideoPredictor``.

    Memory is bounded: frames are read when needed, features and memories lie on the CPU, and memories that the model no
    longer uses are dropped.
    """

    def __init__(self, model: Any, processor: Any, photos: Sequence[Photo], device: str = "cpu") -> None:
        self.model, self.processor, self.photos, self.device = model.to(device), processor, photos, device

    @torch.inference_mode()
    def track(self, prompts: Mapping[int, Prompt], frames: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        session = self.processor.init_video_session(
            inference_device=self.device, inference_state_device="cpu", video_storage_device="cpu"
        )
        session.processed_frames = _Frames(self.processor, self.photos)
        for frame, prompt in prompts.items():
            self._prompt(session, frame, prompt)
            self.model(inference_session=session, frame_idx=frame)  # encodes what is prompted before others are tracked
        reverse = len(frames) > 1 and frames[1] < frames[0]
        for frame in frames:
            output = self.model(inference_session=session, frame_idx=frame, reverse=reverse)
            photo = self.photos[frame]
            low = output.pred_masks.float().reshape(1, 1, *output.pred_masks.shape[-2:])
            logits = torch.nn.functional.interpolate(
                low, (photo.height, photo.width), mode="bilinear", align_corners=False
            )
            yield frame, logits[0, 0].cpu().numpy()
            _forget(session, frame, KEPT_FRAMES)

    def _prompt(self, session: Any, frame: int, prompt: Prompt) -> None:
        photo = self.photos[frame]
        session.video_height, session.video_width = photo.height, photo.width  # photos may differ in size
        inputs: dict[str, Any] = {}
        if prompt.box is not None:
            inputs["input_boxes"] = [[list(prompt.box)]]
        if prompt.points:
            inputs["input_points"] = [[[list(point) for point in prompt.points]]]
            inputs["input_labels"] = [[[int(inside) for inside in prompt.inside]]]
        self.processor.add_inputs_to_inference_session(
            inference_session=session, frame_idx=frame, obj_ids=1, original_size=(photo.height, photo.width), **inputs
        )


class _Frames(dict):
    """The frames of a session, read and prepared on demand; the last one is kept."""

    def __init__(self, processor: Any, photos: Sequence[Photo]) -> None:
        super().__init__()
        self.processor, self.photos = processor, photos

    def __len__(self) -> int:
        return len(self.photos)

    def __missing__(self, frame: int) -> torch.Tensor:
        self.clear()
        prepared = self.processor.image_processor(images=self.photos[frame].pixels(), return_tensors="pt")
        self[frame] = prepared["pixel_values"][0]
        return self[frame]


def _forget(session: Any, frame: int, kept: int) -> None:
    """Drop the memories of tracked (not prompted) frames that lie more than ``kept`` frames away."""
    for outputs in session.output_dict_per_obj.values():
        tracked = outputs["non_cond_frame_outputs"]
        for old in [other for other in tracked if abs(other - frame) > kept]:
            del tracked[old]


class GroundingDino:
    """Grounding DINO as a ``two_stage.Detector``."""

    def __init__(self, model: Any, processor: Any, photos: Sequence[Photo], device: str = "cpu") -> None:
        self.model, self.processor, self.photos, self.device = model.to(device), processor, photos, device

    @torch.inference_mode()
    def detect(self, frame: int, text: str, threshold: float) -> list[tuple[Box, float]]:
        photo = self.photos[frame]
        phrase = text.strip().lower().rstrip(".") + "."  # the model is trained on such phrases
        inputs = self.processor(images=photo.pixels(), text=phrase, return_tensors="pt").to(self.device)
        output = self.model(**inputs)
        found = self.processor.post_process_grounded_object_detection(
            output, inputs["input_ids"], threshold=threshold, target_sizes=[(photo.height, photo.width)]
        )[0]
        boxes = [tuple(float(value) for value in box) for box in found["boxes"]]
        return [(box, float(score)) for box, score in zip(boxes, found["scores"], strict=True)]  # type: ignore[misc]
