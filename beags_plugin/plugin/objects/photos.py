"""The photos of an object of a run, for textures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from beags_plugin.export.base import Photo
from beags_plugin.export.frames import Frame
from beags_plugin.plugin.objects.shown import ShownScene


def photos_of(shown: ShownScene, class_id: int | None, frame: Frame) -> Sequence[Photo]:
    """Return the photos of a class (None: of all of them) in ``frame``; images, masks and depth are read when used."""

    def photo(view: int) -> Photo:
        return Photo(
            frame.camera(shown.views.cameras[view]),
            partial(_image, shown, view),
            partial(_own, shown, view, class_id),
            _depth(shown, view, frame.scale),
        )

    return [photo(view) for view in range(len(shown.views.cameras))]


def _image(shown: ShownScene, view: int) -> Tensor:
    """Return a photo [H, W, 3] in the exposure of the scene."""
    image = shown.photos[view].image.cpu()
    return image if shown.exposures is None else shown.exposures.evened(image, shown.names[view])


def _own(shown: ShownScene, view: int, class_id: int | None) -> Tensor:
    """Return the pixels [H, W] bool of a class; evened exposures make grey of burnt-out ones, so these are left out."""
    labels = shown.views.labels[view].cpu()
    own = torch.ones_like(labels, dtype=torch.bool) if class_id is None else labels == class_id
    return own if shown.exposures is None else own & (shown.photos[view].image.cpu() < 1.0).any(dim=2)


def _depth(shown: ShownScene, view: int, scale: float) -> Callable[[], Tensor]:
    return lambda: shown.views.depths[view].cpu() / scale
