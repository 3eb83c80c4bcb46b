"""The source of SAM 2 and SAM 3 on toy models of random weights: the code for real weights, without their masks."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from data_folders import write_image

from beags_plugin.masks.sources.base import Photo, SourceScene
from beags_plugin.masks.sources.prompts import Prompt
from beags_plugin.masks.sources.sam2 import DETECTORS, TRACKERS, Sam2Source, SamMemory, TextDetector, classes, load
from beags_plugin.system.errors import UserError

transformers = pytest.importorskip("transformers", reason="the extra [sam2] (transformers) is not installed")

SIDE = 64  # pixels that the toy model sees
FRAMES, WIDTH, HEIGHT = 5, 40, 30


def save(model, tracker, folder: Path) -> None:
    tracker.mask_decoder.pred_obj_score_head.proj_out.bias.data.fill_(9.0)  # else it sees no object in some frames
    model.save_pretrained(folder)


@pytest.fixture(scope="module")
def sam2(tmp_path_factory):
    """A folder with a tiny Sam2VideoModel and its processor, as save_pretrained writes them."""
    torch.manual_seed(0)
    backbone = transformers.Sam2HieraDetConfig(
        hidden_size=8, num_attention_heads=1, image_size=[SIDE, SIDE], blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[8, 16, 32, 64], num_attention_heads_per_stage=[1, 1, 1, 1],
        window_size_per_stage=[4, 4, 4, 4], window_positional_embedding_background_size=[4, 4],
        global_attention_blocks=[3],
    )  # fmt: skip
    sizes = [[SIDE // 4] * 2, [SIDE // 8] * 2, [SIDE // 16] * 2]
    vision = transformers.Sam2VisionConfig(
        backbone_config=backbone, backbone_channel_list=[64, 32, 16, 8], backbone_feature_sizes=sizes,
        fpn_hidden_size=128,
    )  # fmt: skip
    config = transformers.Sam2VideoConfig(
        vision_config=vision,
        prompt_encoder_config={"hidden_size": 128, "image_size": SIDE, "patch_size": 16, "mask_input_channels": 4},
        mask_decoder_config={"hidden_size": 128, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 16},
        image_size=SIDE, memory_attention_hidden_size=128, memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=32, memory_attention_rope_feat_sizes=[SIDE // 16] * 2,
        memory_encoder_hidden_size=128, memory_encoder_output_channels=64, mask_downsampler_embed_dim=128,
        memory_fuser_embed_dim=128, memory_fuser_intermediate_dim=32, memory_fuser_num_layers=1,
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("sam2")
    save(model := transformers.Sam2VideoModel(config), model, folder)
    size = {"height": SIDE, "width": SIDE}
    images = transformers.Sam2ImageProcessor(size=size, mask_size={"height": SIDE // 4, "width": SIDE // 4})
    transformers.Sam2VideoProcessor(images, transformers.Sam2VideoVideoProcessor(size=size)).save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def sam3(tmp_path_factory):
    """A folder with a tiny Sam3VideoModel and its processor: a detector and a tracker, as SAM 3 is published."""
    torch.manual_seed(0)
    side, small = 56, {"hidden_size": 128, "num_attention_heads": 2}
    layer = {**small, "num_layers": 1, "intermediate_size": 32}
    vit = transformers.Sam3ViTConfig(
        **small, intermediate_size=32, num_hidden_layers=2, image_size=side, window_size=4, global_attn_indexes=[1],
        pretrain_image_size=side,
    ).to_dict()  # fmt: skip
    vision = {"backbone_config": vit, "fpn_hidden_size": 128, "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]]}
    letters = ["a", "c", "d", "e", "p", "r", "u", "d</w>", "p</w>", "<|startoftext|>", "<|endoftext|>"]
    text = {
        **small, "model_type": "clip_text_model", "vocab_size": len(letters), "intermediate_size": 32,
        "num_hidden_layers": 1, "max_position_embeddings": 32, "bos_token_id": 9, "eos_token_id": 10,
    }  # fmt: skip
    detector = transformers.Sam3Config(
        vision_config=vision, text_config=text, geometry_encoder_config=layer, detr_encoder_config=layer,
        detr_decoder_config={**layer, "num_queries": 6}, mask_decoder_config=small,
    )  # fmt: skip
    tracker = transformers.Sam3TrackerVideoConfig(
        vision_config={**vision, "model_type": "sam3_vision_model"}, image_size=side, mask_downsampler_embed_dim=128,
        prompt_encoder_config={"hidden_size": 128, "image_size": side, "mask_input_channels": 4},
        mask_decoder_config={**small, "mlp_dim": 32, "iou_head_hidden_dim": 16}, memory_attention_hidden_size=128,
        memory_attention_num_layers=1, memory_attention_feed_forward_hidden_size=32, memory_encoder_hidden_size=128,
        memory_encoder_output_channels=64, memory_fuser_embed_dim=128, memory_fuser_intermediate_dim=32,
        memory_fuser_num_layers=1,
    )  # fmt: skip
    config = transformers.Sam3VideoConfig(
        detector_config=detector.to_dict(), tracker_config=tracker.to_dict(), low_res_mask_size=16
    )
    folder = tmp_path_factory.mktemp("sam3")
    save(model := transformers.Sam3VideoModel(config), model.tracker_model, folder)
    size = {"height": side, "width": side}
    transformers.Sam3VideoProcessor(
        transformers.Sam3ImageProcessor(size=size, mask_size={"height": 16, "width": 16}),
        transformers.Sam2VideoVideoProcessor(size=size),
        transformers.CLIPTokenizer(vocab={letter: index for index, letter in enumerate(letters)}, merges=[]),
    ).save_pretrained(folder)
    return folder


@pytest.fixture(params=["sam2", "sam3"])
def weights(request):
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def dino(tmp_path_factory):
    """A tiny Grounding DINO with a vocabulary of a few words."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("dino")
    words = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", "?", "a", "red", "cup"]
    (folder / "vocab.txt").write_text("\n".join(words))
    tokenizer = transformers.BertTokenizerFast(str(folder / "vocab.txt"))
    config = transformers.GroundingDinoConfig(
        backbone_config=transformers.SwinConfig(
            image_size=64, embed_dim=8, depths=[1, 1, 1, 1], num_heads=[1, 1, 2, 2], window_size=4,
            out_features=["stage2", "stage3", "stage4"],
        ),
        text_config=transformers.BertConfig(
            vocab_size=len(words), hidden_size=16, num_hidden_layers=1, num_attention_heads=2, intermediate_size=16
        ),
        d_model=32, encoder_layers=1, encoder_ffn_dim=16, encoder_attention_heads=2, decoder_layers=2,
        decoder_ffn_dim=16, decoder_attention_heads=2, num_queries=12, max_text_len=16, num_feature_levels=3,
    )  # fmt: skip
    transformers.GroundingDinoForObjectDetection(config).save_pretrained(folder)
    size = {"shortest_edge": 64, "longest_edge": 96}
    transformers.GroundingDinoProcessor(transformers.GroundingDinoImageProcessor(size=size), tokenizer).save_pretrained(
        folder
    )
    return folder


@pytest.fixture
def photos(tmp_path):
    found = []
    for index in range(FRAMES):
        image = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
        image[10:20, 10 + index : 20 + index] = (200, 40, 40)
        path = tmp_path / f"images/v{index:02d}.png"
        write_image(path, image)
        found.append(Photo(path.stem, path, WIDTH, HEIGHT))
    return found


def loaded(weights: Path, kinds) -> tuple[Any, Any]:
    return load(str(weights), classes(str(weights), kinds, "model", local=True), local=True)


def tracked(memory: SamMemory, frames: range) -> dict[int, np.ndarray]:
    found = dict(memory.track(frames))
    assert list(found) == list(frames)
    for logits in found.values():
        assert logits.shape == (HEIGHT, WIDTH) and logits.dtype == np.float32 and np.isfinite(logits).all()
    return found


def held(memory: SamMemory, kind: str = "cond") -> list[list[int]]:
    return [sorted(outputs[f"{kind}_frame_outputs"]) for outputs in memory.session.output_dict_per_obj.values()]


def test_a_memory_tracks_both_ways_from_boxes_and_points(weights, photos):
    sam = loaded(weights, TRACKERS)
    memory, other = (SamMemory(*sam, photos) for _ in range(2))
    memory.prompt(2, [Prompt(box=(10, 8, 24, 22))])
    memory.prompt(3, [Prompt(points=((18.0, 15.0), (2.0, 2.0)), inside=(True, False))])
    up = tracked(memory, range(2, 5))
    tracked(memory, range(1, -1, -1))
    assert held(memory) == [[2, 3]]
    ways = {frame: way["reverse"] for frame, way in memory.session.frames_tracked_per_obj[0].items()}
    assert ways == {4: False, 1: True, 0: True}
    other.prompt(2, [Prompt(box=(0, 0, 5, 5))])
    assert np.abs(tracked(other, range(2, 3))[2] - up[2]).max() > 0  # the prompt matters


def test_a_prompt_in_a_tracked_frame_stays_in_the_same_memory(weights, photos):
    sam, again = loaded(weights, TRACKERS), Prompt(box=(13, 8, 26, 22))
    memory, fresh = (SamMemory(*sam, photos) for _ in range(2))
    memory.prompt(0, [Prompt(box=(10, 8, 24, 22))])
    before = tracked(memory, range(FRAMES))
    for one in (memory, fresh):
        one.prompt(3, [again])
    # What was tracked about a lost frame would tell that the object is absent.
    assert held(memory, "non_cond") == [[]]
    after, alone = tracked(memory, range(3, FRAMES)), tracked(fresh, range(3, FRAMES))
    assert held(memory) == [[0, 3]]
    assert np.abs(after[3] - before[3]).max() > 0
    np.testing.assert_array_equal(after[3], alone[3])  # The prompt alone says what is in its frame.
    assert np.abs(after[4] - alone[4]).max() > 0  # The first prompt is known in the other frames.


def test_an_object_of_several_parts_is_their_union(weights, photos):
    sam, boxes = loaded(weights, TRACKERS), [Prompt(box=(10, 8, 24, 22)), Prompt(box=(30, 2, 38, 9))]
    both, *alone = (SamMemory(*sam, photos) for _ in range(3))
    both.prompt(1, boxes)
    for memory, box in zip(alone, boxes, strict=True):
        memory.prompt(1, [box])
    both.prompt(3, [*boxes, Prompt(box=(1, 1, 5, 5))])  # a part that the first frame did not show
    assert held(both) == [[1, 3], [1, 3], [3]]
    one, two = (tracked(memory, range(1, 2))[1] for memory in alone)
    found = tracked(both, range(1, FRAMES))[1]
    assert (found >= np.maximum(one, two) - 1e-4).all()


def test_a_memory_forgets_what_the_model_no_longer_looks_at(weights, photos, monkeypatch):
    monkeypatch.setattr("beags_plugin.masks.sources.sam2.KEPT_FRAMES", 1)
    memory, kept = SamMemory(*loaded(weights, TRACKERS), photos), []
    memory.prompt(0, [Prompt(box=(10, 8, 24, 22))])
    for _ in memory.track(range(FRAMES)):
        kept += held(memory, "non_cond")
        assert len(memory.session.processed_frames.keys()) <= 1 and held(memory) == [[0]]
    assert kept == [[], [1], [1, 2], [1, 2, 3], [2, 3, 4]]  # frames held as each next one is tracked
    outputs = memory.session.output_dict_per_obj[0]
    assert not any("high_res_masks" in one for group in outputs.values() for one in group.values())


def test_a_memory_agrees_with_a_whole_video_that_the_library_tracks(weights, photos):
    model, processor = loaded(weights, TRACKERS)
    memory = SamMemory(model, processor, photos)
    memory.prompt(0, [Prompt(box=(8, 8, 22, 22))])
    found = tracked(memory, range(FRAMES))
    frames = [processor.image_processor(images=photo.pixels(), return_tensors="pt") for photo in photos]
    session = processor.init_video_session()
    session.processed_frames = {index: frame["pixel_values"][0] for index, frame in enumerate(frames)}
    processor.add_inputs_to_inference_session(
        session, frame_idx=0, obj_ids=1, input_boxes=[[[8, 8, 22, 22]]], original_size=(HEIGHT, WIDTH)
    )
    with torch.inference_mode():
        for output in model.propagate_in_video_iterator(session, start_frame_idx=0):
            low = output.pred_masks.reshape(1, 1, *output.pred_masks.shape[-2:])
            whole = processor.post_process_masks([low], [[HEIGHT, WIDTH]], binarize=False)[0].reshape(HEIGHT, WIDTH)
            np.testing.assert_allclose(found[output.frame_idx], whole.numpy(), atol=2e-3)


def made(folder: Path, photos, objects: list, **options) -> tuple[dict, list]:
    (folder / "prompts.json").write_text(json.dumps({"objects": objects}))
    source = Sam2Source(local=True, device="cpu", **options)
    found = source.make(SourceScene(folder, photos), lambda done, total: None)
    return dict(found.names), list(found.maps)


def test_the_source_makes_a_map_of_every_view(weights, photos, tmp_path):
    objects = [
        {"name": "red", "prompts": [{"view": "v02", "box": [10, 8, 24, 22]}]},
        {"name": "other", "id": 7, "prompts": [{"view": "v00", "points": [[30, 5]]}]},
    ]
    names, maps = made(tmp_path, photos, objects, model=str(weights))
    assert names == {0: "background", 1: "red", 7: "other"}
    assert [m.shape for m in maps] == [(HEIGHT, WIDTH)] * FRAMES
    assert set(np.unique(np.stack(maps)).tolist()) <= {0, 1, 7}


def test_held_out_photos_are_never_seen(sam2, photos, tmp_path):
    photos[1] = replace(photos[1], trained=False, path=tmp_path / "absent.png")  # reading it would fail

    def maps(view: str) -> list:
        objects = [{"name": "red", "prompts": [{"view": view, "box": [10, 8, 24, 22]}]}]
        return made(tmp_path, photos, objects, model=str(sam2))[1]

    assert [index for index, labels in enumerate(maps("v02")) if labels is None] == [1]
    with pytest.raises(UserError, match="prompts in v01, which is held out"):
        maps("v01")


@pytest.mark.parametrize("kind", ["dino", "sam3"])
def test_a_detector_gives_boxes_in_pixels_above_the_threshold(kind, photos, request):
    detector = TextDetector(*loaded(request.getfixturevalue(kind), DETECTORS), photos)
    found = detector.detect(0, "A red cup", threshold=0.0)
    assert found and all(len(box) == 4 and 0.0 <= score <= 1.0 for box, score in found)
    assert max(abs(value) for box, _ in found for value in box) > 2  # pixels, not shares of the image
    limit = sorted(score for _, score in found)[len(found) // 2]
    assert 0 < len(detector.detect(0, "a red cup.", threshold=limit)) < len(found)
    with pytest.raises(UserError, match="is too long for the detector"):
        detector.detect(0, "a red cup " * 60, threshold=0.0)


def test_a_text_needs_no_other_weights_with_sam3_and_a_detector_with_sam2(sam2, sam3, dino, photos, tmp_path):
    objects = [{"name": "cup", "text": "red cup"}]
    for options in ({"model": str(sam3)}, {"model": str(sam2), "detector": str(dino)}):
        assert len(made(tmp_path, photos, objects, threshold=0.0, strict=0.0, **options)[1]) == FRAMES
    with pytest.raises(UserError, match="the weights IDEA-Research/grounding-dino-tiny cannot be loaded"):
        made(tmp_path, photos, objects, model=str(sam2))


def test_prompts_and_the_weights_of_both_models_are_checked_before_masks_are_made(sam2, dino, tmp_path):
    source = Sam2Source(prompts=tmp_path / "prompts.json", model=str(sam2), detector="/none/such", local=True)
    with pytest.raises(UserError, match=r"prompts\.json cannot be read"):
        source.check()
    source.prompts.write_text(json.dumps({"objects": [{"name": "cup", "text": "red cup"}]}))
    with pytest.raises(UserError, match="there is no folder /none/such"):
        source.check()
    replace(source, detector=str(dino)).check()


def test_without_a_network_the_sentence_comes_without_tries(tmp_path, monkeypatch, caplog):
    """The hub's client would try for half a minute, and print a line for each try."""
    import huggingface_hub
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    huggingface_hub.close_session()
    with pytest.raises(
        UserError, match=r"no connection to http://127\.0\.0\.1:9\): name a folder that holds them, or go"
    ):
        classes("nobody/nothing", TRACKERS, "video model")
    assert not caplog.records, "each try would log a line"


def test_weights_of_the_hub_are_asked_for_only_if_they_are_not_here(sam2, monkeypatch):
    read, asked = transformers.PretrainedConfig.get_config_dict, []

    def stored(name, **options):
        asked.append(options.get("local_files_only", False))
        return read(sam2, **options)

    monkeypatch.setattr(transformers.PretrainedConfig, "get_config_dict", stored)
    assert classes("nobody/nothing", TRACKERS, "video model")[0] is transformers.Sam2VideoModel and asked == [True]


def test_the_parts_of_sam3_are_loaded_from_its_weights(sam3):
    whole = transformers.Sam3VideoModel.from_pretrained(sam3).state_dict()
    model, _ = loaded(sam3, DETECTORS)
    assert all(torch.equal(value, whole[f"detector_model.{name}"]) for name, value in model.state_dict().items())
    own = loaded(sam3, TRACKERS)[0].state_dict()
    assert torch.equal(own["memory_encoder.projection.weight"], whole["tracker_model.memory_encoder.projection.weight"])
    backbone = [name for name in own if name.startswith("vision_encoder.backbone.")]
    assert backbone and all(torch.equal(own[name], whole[f"detector_model.{name}"]) for name in backbone)
