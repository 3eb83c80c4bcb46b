"""The source rembg on a stand-in for the library, with its functions as it documents them."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from data_folders import write_image
from PIL import Image
from source_scenes import coloured, make

from beags_plugin.masks.sources.base import Photo, SourceScene
from beags_plugin.masks.sources.rembg import RembgSource
from beags_plugin.objects.make_masks import configured_source
from beags_plugin.system.errors import UserError

MODELS = ("u2net", "isnet-general-use", "birefnet-general", "sam", "withoutbg")


@pytest.fixture
def library(monkeypatch):
    """A package rembg whose models have weights, but for u2net; red stands for the networks."""
    library, sessions = ModuleType("rembg"), ModuleType("rembg.sessions")

    def new_session(model_name="u2net", *args, **kwargs):
        if model_name not in MODELS:
            raise ValueError(f"No session class found for model '{model_name}'")
        if model_name == "u2net":
            raise ConnectionError("Max retries exceeded\nwith url: /releases")
        return model_name

    def remove(data, *args, session=None, only_mask=False, **kwargs):
        assert isinstance(data, np.ndarray) and only_mask, "an array comes back for an array, a mask where it is asked"
        assert session == "birefnet-general"
        red = np.asarray(Image.fromarray(data))[..., 0] > 150
        return np.where(red, 200, 127).astype(np.uint8)

    library.new_session, library.remove, library.sessions = new_session, remove, sessions  # type: ignore[attr-defined]
    sessions.sessions_names = list(MODELS)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "rembg", library)
    monkeypatch.setitem(sys.modules, "rembg.sessions", sessions)
    return library


@pytest.fixture
def scene(tmp_path):
    photo, _ = coloured()
    path = tmp_path / "images/v0.png"
    photo[2:4, 2:4] = (230, 20, 30)  # a small piece apart from the thing
    write_image(path, photo)
    one = Photo("v0", path, photo.shape[1], photo.shape[0])
    return SourceScene(tmp_path, [one, replace(one, trained=False)])


def test_what_a_model_says_of_a_photo_becomes_one_object(library, scene):
    names, maps = make(RembgSource("birefnet-general", "cup"), scene)
    assert names == {0: "background", 1: "cup"} and maps[1] is None
    labels, truth = maps[0], coloured()[1]
    assert labels is not None and labels.dtype == np.uint16 and not labels[2:4, 2:4].any()
    assert ((labels == 1) & truth).sum() / ((labels == 1) | truth).sum() > 0.9


def test_models_that_photos_alone_do_not_serve_are_refused(library, scene):
    for name in ("birefnet", "sam", "withoutbg"):
        known = r"choose one of birefnet-general, isnet-general-use, u2net\."
        with pytest.raises(UserError, match=rf"no model '{name}' of rembg for photos alone.*: {known}"):
            make(RembgSource(name), scene)


def test_weights_that_cannot_be_had_are_named(library, scene, monkeypatch, tmp_path):
    monkeypatch.setenv("U2NET_HOME", str(tmp_path))
    sentence = r"fetch the weights of u2net, or load them \(ConnectionError\): .* put them at .*/u2net\.onnx\."
    with pytest.raises(UserError, match=sentence):
        make(RembgSource("u2net"), scene)


def test_a_library_that_is_absent_or_broken_is_named(scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "rembg", None)
    with pytest.raises(UserError, match="the library rembg cannot be imported .*: pip install rembg onnxruntime"):
        make(RembgSource(), scene)
    monkeypatch.setattr("beags_plugin.masks.sources.rembg.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"source rembg cannot run: .* not installed: pip install rembg 'numpy<2'\."):
        configured_source("rembg", ["model=birefnet-general"])
