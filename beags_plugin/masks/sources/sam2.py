"""Source of masks: two-stage retrieval with the video models of SAM 2 and SAM 3, from the library transformers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import numpy as np
import torch

from beags_plugin.masks.sources.base import MadeMasks, MaskSource, Photo, Progress, SourceScene
from beags_plugin.masks.sources.prompts import Prompt, PromptedObject, read_prompts
from beags_plugin.masks.sources.two_stage import BestLabels, Box, retrieve
from beags_plugin.system.errors import UserError

KEPT_FRAMES = 16  # frames around the tracked one that an object's memory keeps; the models use at most 15
# Classes of the model and of its processor, by the model type that the config of the weights names.
TRACKERS = {
    "sam2_video": ("Sam2VideoModel", "Sam2VideoProcessor"),
    "sam3_video": ("Sam3TrackerVideoModel", "Sam3TrackerVideoProcessor"),
    "sam3_tracker_video": ("Sam3TrackerVideoModel", "Sam3TrackerVideoProcessor"),
}
DETECTORS = {
    "sam3_video": ("Sam3Model", "Sam3Processor"),
    "grounding-dino": ("GroundingDinoForObjectDetection", "GroundingDinoProcessor"),
    "mm-grounding-dino": ("MMGroundingDinoForObjectDetection", "GroundingDinoProcessor"),
}


@dataclass(frozen=True)
class Sam2Source(MaskSource):
    """Objects that SAM 2 or SAM 3 tracks through the training views in the order of names, from points, boxes or texts.

    prompts: JSON, see ``prompts.read_prompts``. model, detector: a folder with the library's files, or a name on its
    hub. The detector is loaded only if an object has a text; "auto" is SAM 3 itself, or Grounding DINO for SAM 2.
    device: "auto" prefers CUDA. threshold: least score of a detection in stage 1. strict: the same in stage 2, where a
    wrong detection would add an object that is not there. local: never use the hub.
    """

    guesses: ClassVar[bool] = True

    prompts: Path = Path("prompts.json")
    model: str = "facebook/sam2.1-hiera-small"
    detector: str = "auto"
    device: str = "auto"
    threshold: float = 0.3
    strict: float = 0.6
    local: bool = False

    @classmethod
    def unavailable(cls) -> str | None:
        if find_spec("transformers") is None:
            return "the library transformers is not installed: pip install 'transformers>=5.0'."
        return None

    def check(self) -> None:
        objects = read_prompts(self.prompts)
        self._trackers()
        self._detectors(objects)

    def _trackers(self) -> list[Any]:
        """Return the library's classes for the model and its processor."""
        return classes(self.model, TRACKERS, "video model of SAM 2 or SAM 3", self.local)

    def _detectors(self, objects: Sequence[PromptedObject]) -> tuple[str, list[Any]] | None:
        """Return the name of the detector, and the library's classes for it and its processor; None without texts."""
        if not any(one.text for one in objects):
            return None
        finder = self.detector
        if finder == "auto":
            finds = model_type(self.model, self.local) in DETECTORS
            finder = self.model if finds else "IDEA-Research/grounding-dino-tiny"
        return finder, classes(finder, DETECTORS, "detector of texts", self.local)

    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        path = scene.below(self.prompts)
        objects = read_prompts(path)
        photos = [photo for photo in scene.photos if photo.trained]
        views = {view for one in objects for view in one.prompts}
        frame_of = {view: photos.index(scene.photos[scene.prompted_view(view, path)]) for view in sorted(views)}
        device = self.device
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        trackers = self._trackers()
        detectors = self._detectors(objects)
        tracker = load(self.model, trackers, self.local)
        detector = None
        if detectors is not None:
            detector = TextDetector(*load(*detectors, self.local), photos, device)
        names = {0: "background", **{one.class_id: one.name for one in objects}}
        notes: list[str] = []

        def maps() -> Iterator[np.ndarray | None]:
            with TemporaryDirectory(prefix="beags-sam2-") as folder:
                best = BestLabels(Path(folder))
                names = [photo.name for photo in photos]
                new_memory = partial(SamMemory, *tracker, photos, device)
                notes.extend(
                    retrieve(
                        objects, frame_of, names, new_memory, detector, best, self.threshold, self.strict, progress
                    )
                )
                frames = iter(range(len(photos)))
                for photo in scene.photos:
                    yield best.labels(next(frames), (photo.height, photo.width)) if photo.trained else None

        return MadeMasks(names, maps(), notes)


def model_type(name: str, local: bool = False) -> str:
    """Return the model type of the weights in a folder or on the hub; raise ``UserError``."""
    import transformers  # pyright: ignore[reportMissingImports]

    if not (Path(name).is_dir() or re.fullmatch(r"[\w.-]+(/[\w.-]+)?", name)):
        raise UserError(f"there is no folder {name}: name one that holds the weights, or a model of the hub.")
    read = transformers.PretrainedConfig.get_config_dict
    try:
        try:
            return str(read(name, local_files_only=True)[0].get("model_type"))
        except OSError:
            if local or Path(name).is_dir():
                raise
        _reach_hub()  # The library itself would try for half a minute.
        return str(read(name)[0].get("model_type"))
    except (OSError, ValueError) as error:
        raise _not_loaded(name, error) from error


def _reach_hub() -> None:
    """Raise ``ConnectionError`` if the hub does not answer."""
    from huggingface_hub import constants, get_session  # pyright: ignore[reportMissingImports]

    try:
        get_session().head(constants.ENDPOINT, timeout=10)
    except Exception as error:  # Which library speaks HTTP depends on the client's version.
        raise ConnectionError(f"no connection to {constants.ENDPOINT}") from error


def classes(name: str, kinds: Mapping[str, tuple[str, str]], what: str, local: bool = False) -> list[Any]:
    """Return the classes in ``kinds`` for the model type of some weights; raise ``UserError`` without any."""
    import transformers  # pyright: ignore[reportMissingImports]

    kind = model_type(name, local)
    if kind not in kinds:
        raise UserError(f"the weights {name} (model type {kind}) are no {what}: name some of {', '.join(kinds)}.")
    try:
        return [getattr(transformers, one) for one in kinds[kind]]
    except AttributeError as error:
        raise UserError(
            f"transformers {transformers.__version__} is too old for the weights {name} (model type {kind}): pip "
            "install -U transformers."
        ) from error


def load(name: str, loaders: Sequence[Any], local: bool = False) -> tuple[Any, Any]:
    """Load a model and its processor, of the classes ``loaders``, from a folder or the hub; raise ``UserError``."""
    from safetensors import SafetensorError

    try:
        model, processor = (loader.from_pretrained(name, local_files_only=local) for loader in loaders)
    except (ImportError, OSError, RuntimeError, ValueError, SafetensorError) as error:
        raise _not_loaded(name, error) from error
    return model.eval(), processor


def _not_loaded(name: str, error: Exception) -> UserError:
    reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
    return UserError(
        f"the weights {name} cannot be loaded ({reason}): name a folder that holds them, or go online once."
    )


class SamMemory:
    """A session of SAM 2 or SAM 3 as a ``two_stage.Memory``.

    Its memory is bounded, except for prompted frames: frames are read when needed, and memories of tracked frames that
    the model no longer uses are dropped.
    """

    def __init__(self, model: Any, processor: Any, photos: Sequence[Photo], device: str = "cpu") -> None:
        self.model, self.processor, self.photos = model.to(device), processor, photos
        self.session = processor.init_video_session(
            inference_device=device, inference_state_device="cpu", video_storage_device="cpu"
        )
        self.session.processed_frames = _Frames(processor, photos)

    @torch.inference_mode()
    def prompt(self, frame: int, places: Sequence[Prompt]) -> None:
        inputs: dict[str, Any] = {}
        if places[0].box is not None:
            inputs["input_boxes"] = [[list(place.box or ()) for place in places]]
        if places[0].points:
            inputs["input_points"] = [[[list(point) for point in place.points] for place in places]]
            inputs["input_labels"] = [[[int(inside) for inside in place.inside] for place in places]]
        photo = self.photos[frame]  # photos may differ in size
        self.processor.add_inputs_to_inference_session(
            inference_session=self.session,
            frame_idx=frame,
            obj_ids=list(range(1, len(places) + 1)),
            original_size=(photo.height, photo.width),
            **inputs,
        )
        # The library keeps a prompt in memory only if its frame was not tracked before, and tracked frames around a
        # lost one would tell the model that the object is absent.
        for tracked in self.session.frames_tracked_per_obj.values():
            tracked.pop(frame, None)
        for outputs in self.session.output_dict_per_obj.values():
            outputs["non_cond_frame_outputs"].clear()
        self.model(inference_session=self.session, frame_idx=frame)  # encodes the prompt before others are tracked

    @torch.inference_mode()
    def track(self, frames: range) -> Iterator[tuple[int, np.ndarray]]:
        for frame in frames:
            output = self.model(inference_session=self.session, frame_idx=frame, reverse=frames.step < 0)
            photo = self.photos[frame]
            parts = output.pred_masks.float().amax(dim=0, keepdim=True)
            logits = torch.nn.functional.interpolate(
                parts, (photo.height, photo.width), mode="bilinear", align_corners=False
            )
            yield frame, logits[0, 0].cpu().numpy()
            self._forget(frame)

    def _forget(self, frame: int) -> None:
        """Drop memories of tracked frames far from ``frame``, and full-size masks that have been encoded."""
        for outputs in self.session.output_dict_per_obj.values():
            tracked = outputs["non_cond_frame_outputs"]
            for old in [other for other in tracked if abs(other - frame) > KEPT_FRAMES]:
                del tracked[old]
            for held in (*tracked.values(), *outputs["cond_frame_outputs"].values()):
                held.pop("high_res_masks", None)


class _Frames(dict):
    """The frames of a session, read and prepared on demand; only the last one stays in memory."""

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


class TextDetector:
    """SAM 3's detector or Grounding DINO as a ``two_stage.Detector``."""

    def __init__(self, model: Any, processor: Any, photos: Sequence[Photo], device: str = "cpu") -> None:
        self.model, self.processor, self.photos, self.device = model.to(device), processor, photos, device

    @torch.inference_mode()
    def detect(self, frame: int, text: str, threshold: float) -> list[tuple[Box, float]]:
        photo, text = self.photos[frame], text.strip()
        grounding = hasattr(self.processor, "post_process_grounded_object_detection")
        if grounding:
            text = text.lower().rstrip(".") + "."  # the model was trained on lower case with a full stop
        inputs = self.processor(images=photo.pixels(), text=text, return_tensors="pt").to(self.device)
        config = self.model.config
        if inputs["input_ids"].shape[1] > getattr(config, "max_text_len", config.text_config.max_position_embeddings):
            raise UserError(f"the text {text!r} is too long for the detector: name the object in a few words.")
        output, sizes = self.model(**inputs), [(photo.height, photo.width)]
        if grounding:
            result = self.processor.post_process_grounded_object_detection(
                output, inputs["input_ids"], threshold=threshold, target_sizes=sizes
            )[0]
        else:
            result = self.processor.post_process_object_detection(output, threshold=threshold, target_sizes=sizes)[0]
        boxes = [tuple(float(value) for value in box) for box in result["boxes"]]
        return [(box, float(score)) for box, score in zip(boxes, result["scores"], strict=True)]  # type: ignore[misc]
