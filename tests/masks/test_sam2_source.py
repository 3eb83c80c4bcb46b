"""The SAM2 source on toy models of random weights: the code for real weights, without their masks."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from data_folders import write_image

from beags_plugin.masks.sources.base import Photo, SourceScene
from beags_plugin.masks.sources.prompts import Prompt
from beags_plugin.masks.sources.sam2 import GroundingDino, Sam2Predictor, Sam2Source, load
from beags_plugin.system.errors import UserError

transformers = pytest.importorskip("transformers", reason="the extra [sam2] (transformers) is not installed")

SIDE = 64  # pixels that the toy model sees
FRAMES, WIDTH, HEIGHT = 5, 40, 30


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
    transformers.Sam2VideoModel(config).save_pretrained(folder)
    size = {"height": SIDE, "width": SIDE}
    images = transformers.Sam2ImageProcessor(size=size, mask_size={"height": SIDE // 4, "width": SIDE // 4})
    transformers.Sam2VideoProcessor(images, transformers.Sam2VideoVideoProcessor(size=size)).save_pretrained(folder)
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


def test_the_predictor_tracks_both_ways(sam2, photos):
    predictor = Sam2Predictor(*load(str(sam2), "Sam2VideoModel", local=True), photos)
    prompts = {2: Prompt(box=(10, 8, 24, 22)), 3: Prompt(points=((18.0, 15.0), (2.0, 2.0)), inside=(True, False))}
    up = list(predictor.track(prompts, [2, 3, 4]))
    down = list(predictor.track(prompts, [2, 1, 0]))
    assert [frame for frame, _ in up] == [2, 3, 4] and [frame for frame, _ in down] == [2, 1, 0]
    for _, logits in up + down:
        assert logits.shape == (HEIGHT, WIDTH) and logits.dtype == np.float32 and np.isfinite(logits).all()
    np.testing.assert_array_equal(up[0][1], down[0][1])  # calls know nothing of each other
    other = next(iter(predictor.track({2: Prompt(box=(0, 0, 5, 5))}, [2, 3])))[1]
    assert np.abs(other - up[0][1]).max() > 0  # the prompt matters


def test_the_predictor_forgets_what_the_model_no_longer_looks_at(sam2, photos, monkeypatch):
    from beags_plugin.masks.sources import sam2 as module

    held, forget = [], module._forget

    def observed(session, frame, kept):
        forget(session, frame, kept)
        outputs = next(iter(session.output_dict_per_obj.values()))
        held.append((sorted(outputs["cond_frame_outputs"]), sorted(outputs["non_cond_frame_outputs"])))
        assert len(session.processed_frames.keys()) <= 1

    monkeypatch.setattr(module, "KEPT_FRAMES", 1)
    monkeypatch.setattr(module, "_forget", observed)
    predictor = Sam2Predictor(*load(str(sam2), "Sam2VideoModel", local=True), photos)
    list(predictor.track({0: Prompt(box=(10, 8, 24, 22))}, range(FRAMES)))
    assert held == [([0], []), ([0], [1]), ([0], [1, 2]), ([0], [2, 3]), ([0], [3, 4])]


def test_the_predictor_agrees_with_a_whole_video_in_memory(sam2, photos):
    model, processor = load(str(sam2), "Sam2VideoModel", local=True)
    found = dict(Sam2Predictor(model, processor, photos).track({0: Prompt(box=(8, 8, 22, 22))}, range(FRAMES)))
    session = processor.init_video_session(video=[photo.pixels() for photo in photos])
    processor.add_inputs_to_inference_session(session, frame_idx=0, obj_ids=1, input_boxes=[[[8, 8, 22, 22]]])
    with torch.inference_mode():
        for output in model.propagate_in_video_iterator(session, start_frame_idx=0):
            low = output.pred_masks.reshape(1, 1, *output.pred_masks.shape[-2:])
            whole = processor.post_process_masks([low], [[HEIGHT, WIDTH]], binarize=False)[0].reshape(HEIGHT, WIDTH)
            np.testing.assert_allclose(found[output.frame_idx], whole.numpy(), atol=2e-3)


def test_the_source_makes_a_map_of_every_view(sam2, photos, tmp_path):
    objects = [
        {"name": "red", "prompts": [{"view": "v02", "box": [10, 8, 24, 22]}]},
        {"name": "other", "id": 7, "prompts": [{"view": "v00", "points": [[30, 5]]}]},
    ]
    (tmp_path / "prompts.json").write_text(json.dumps({"objects": objects}))
    source = Sam2Source(Path("prompts.json"), model=str(sam2), local=True, device="cpu")
    made = source.make(SourceScene(tmp_path, photos), lambda done, total: None)
    maps = list(made.maps)
    assert made.names == {0: "background", 1: "red", 7: "other"}
    assert [m.shape for m in maps] == [(HEIGHT, WIDTH)] * FRAMES
    assert set(np.unique(np.stack(maps)).tolist()) <= {0, 1, 7}


def test_held_out_photos_are_never_seen(sam2, photos, tmp_path):
    photos[1] = replace(photos[1], trained=False, path=tmp_path / "absent.png")  # reading it would fail
    source = Sam2Source(Path("prompts.json"), model=str(sam2), local=True, device="cpu")

    def maps(view: str) -> list:
        objects = [{"name": "red", "prompts": [{"view": view, "box": [10, 8, 24, 22]}]}]
        (tmp_path / "prompts.json").write_text(json.dumps({"objects": objects}))
        return list(source.make(SourceScene(tmp_path, photos), lambda done, total: None).maps)

    assert [index for index, labels in enumerate(maps("v02")) if labels is None] == [1]
    with pytest.raises(UserError, match="prompts in v01, which is held out"):
        maps("v01")


def test_missing_weights_are_refused(tmp_path):
    with pytest.raises(UserError, match="there is no folder .*: name one that holds"):
        load(str(tmp_path / "nothing"), "Sam2VideoModel", local=True)


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


def test_the_detector_gives_boxes_in_pixels_above_the_threshold(dino, photos):
    detector = GroundingDino(*load(str(dino), "GroundingDinoForObjectDetection", local=True), photos)
    found = detector.detect(0, "A red cup", threshold=0.0)
    assert found and all(len(box) == 4 and 0.0 <= score <= 1.0 for box, score in found)
    assert max(abs(value) for box, _ in found for value in box) > 2  # pixels, not shares of the image
    limit = sorted(score for _, score in found)[len(found) // 2]
    assert 0 < len(detector.detect(0, "a red cup.", threshold=limit)) < len(found)


def test_a_text_prompts_the_first_stage(sam2, dino, photos, tmp_path):
    (tmp_path / "prompts.json").write_text('{"objects": [{"name": "cup", "text": "red cup"}]}')
    source = Sam2Source(
        Path("prompts.json"), str(sam2), str(dino), "cpu", threshold=0.0, strict=0.0, retries=1, local=True
    )
    made = source.make(SourceScene(tmp_path, photos), lambda done, total: None)
    assert len(list(made.maps)) == FRAMES
