"""Exposures of photos, learned with the scene: an affine colour transform per photo, whose mean is the identity."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.exposure import Exposures, Gains, gains, sightings
from beags_plugin.core.schedule import log_linear
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.losses.reduction import ordered_linear
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.plugin.views.dataparser import BeagsDataParser
from beags_plugin.surfaces.baking import interpolated
from beags_plugin.surfaces.color import linear_from_srgb
from beags_plugin.system.progress import counted, progress_bar, say
from beags_plugin.views.views import View, in_unit_range

LEAST_SPREAD = 0.05  # EV; photos whose gains differ by less count as one exposure.
CERTAIN = 3.0  # Photos differ if their gains differ by so many times the noise of a gain.
RATES = 1e-2, 1e-3  # First and last learning rate of the transforms, log-linear, as in 3DGS.
BETAS, EPS = (0.9, 0.999), 1e-15  # Adam's.
TOWARDS_START = 0.05  # Weight of the squared distance of a photo's transform from its start.
OPAQUE = 242  # Least alpha, of 255, of a pixel that shows the scene.
GAMMA, OFFSET = 2.4, 0.055
"""sRGB's curve above its darkest values is (1 + OFFSET) light^(1 / GAMMA) - OFFSET; there a gain is an affine map."""


class PhotoExposures:
    """The transforms of V photos while they are learned; their mean over the photos is the identity throughout.

    Each step moves its photo's transform by Adam, with the gradient of the training loss and of a pull towards the
    start. Every photo has its own moments and step count, so that its step size does not depend on the number of
    photos.
    """

    def __init__(self, model: SceneModel, exposures: Exposures) -> None:
        self.model = model
        self.affine = exposures.affine.to(model.device).clone().requires_grad_()
        self.start = self.affine.detach().clone()
        self.identity = torch.eye(3, 4).to(self.affine)
        self.moments = torch.zeros(2, *self.affine.shape).to(self.affine)  # Adam's first and second.
        self.steps = torch.zeros(len(self.affine), dtype=torch.long)
        model.exposures = Exposures(exposures.names, self.affine.detach())  # Both share the memory.
        self._photo: int | None = None  # Photo of the present step.

    def state(self) -> dict[str, Any]:
        """Return the start of the transforms, their moments and steps; see ``Resumable``."""
        return {"start": self.start.cpu(), "moments": self.moments.cpu(), "steps": self.steps.clone()}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from ``state``; the model has the transforms."""
        self.start, self.moments = state["start"].to(self.start), state["moments"].to(self.moments)
        self.steps = state["steps"].clone()

    def __call__(self, colors: Tensor, photo: int) -> Tensor:
        """Return colours [N, 3] as the photo shows them, with a gradient for its transform."""
        self._photo = photo if torch.is_grad_enabled() else None
        affine = self.affine[photo]
        return ordered_linear(colors, affine[:, :3], affine[:, 3])

    def after_step(self, step: int) -> None:
        """Update the transform of this step's photo."""
        gradient = self.affine.grad
        if (photo := self._photo) is None or gradient is None:
            return
        with torch.no_grad():
            gradient[photo] += 2.0 * TOWARDS_START * (self.affine[photo] - self.start[photo])
            rate = log_linear(*RATES, self.model.schedule.progress(step))
            self.affine[photo] -= rate * self._direction(photo, gradient[photo])
            self.affine -= self.affine.mean(dim=0) - self.identity
        self.affine.grad, self._photo = None, None

    def _direction(self, photo: int, gradient: Tensor) -> Tensor:
        """Return Adam's step [3, 4] of a photo at rate 1."""
        self.steps[photo] += 1
        steps = int(self.steps[photo])
        first, second = self.moments[0, photo], self.moments[1, photo]
        first.lerp_(gradient, 1.0 - BETAS[0])
        second.lerp_(gradient.square(), 1.0 - BETAS[1])
        return (first / (1.0 - BETAS[0] ** steps)) / ((second / (1.0 - BETAS[1] ** steps)).sqrt() + EPS)


def exposures_of_run(model: SceneModel, datamanager: BeagsDataManager) -> PhotoExposures | None:
    """Return the photos' exposures to learn, starting from those of a loaded scene if it has any.

    None if the photos have one exposure, or if there are no tracks of points to compare them by. With the option "on"
    they then begin at the identity.
    """
    option = model.config.exposure
    if option == "off":
        model.exposures = None
        return None
    names = tuple(view.name for view in datamanager.views("train"))
    start = torch.eye(3, 4).repeat(len(names), 1, 1)
    if (known := model.exposures) is not None:
        of_name = dict(zip(known.names, known.affine.cpu(), strict=True))
        of_photos = [of_name.get(name, identity) for name, identity in zip(names, start, strict=True)]
        return PhotoExposures(model, Exposures(names, torch.stack(of_photos)))
    if option == "auto" and datamanager.config.photos == "objects":
        return None  # The objects turned in a light that stood still, which changes their brightness too.
    if (measured := photo_gains(datamanager)) is None:
        return PhotoExposures(model, Exposures(names, start)) if option == "on" else None
    noise = float(np.median(measured.noise))
    differ = max(measured.spread, measured.spread_of_colors) > max(LEAST_SPREAD, CERTAIN * noise)
    learned = option == "on" or differ
    for line in _lines(measured, names, learned):
        say(line)
    return _at_gains(model, names, measured) if learned else None


def _at_gains(model: SceneModel, names: tuple[str, ...], measured: Gains) -> PhotoExposures:
    """Return transforms that begin at the gains of photos."""
    start = torch.eye(3, 4).repeat(len(names), 1, 1)
    slopes = 2.0 ** (measured.stops / GAMMA)  # [V, 3]
    factors = torch.from_numpy(slopes / slopes.mean(axis=0)).float()
    start[:, range(3), range(3)] = factors
    start[:, :, 3] = OFFSET * (factors - 1.0)
    return PhotoExposures(model, Exposures(names, start))


def photo_gains(datamanager: BeagsDataManager) -> Gains | None:
    """Return the gains of the training photos, from their shared points; None without tracks."""
    tracks = cast(BeagsDataParser, datamanager.dataparser).tracks("train")
    if not any((ids >= 0).any() for ids, _ in tracks):
        return None
    places, light = [], []
    with progress_bar("Comparing exposures", passing=True) as progress:
        for index, view in enumerate(counted(datamanager.views("train"), len(tracks), progress)):
            data = view.data()
            image = in_unit_range(data["image"]).cpu()
            ids, shares = tracks[index]
            xy = datamanager.files["train"].straightened(shares, index)[1]
            inside = ((xy >= 0) & (xy < image.shape[1::-1])).all(axis=1)  # An undistorted photo shows less.
            inside[inside] = _used(view, data, datamanager)[tuple(xy[inside].astype(np.int64).T[::-1])]
            places.append(np.where(inside, ids, -1))
            light.append(linear_from_srgb(interpolated(image, xy)))
    return gains(sightings(places, light), len(tracks))


def _used(view: View, data: dict[str, Tensor], datamanager: BeagsDataManager) -> np.ndarray:
    """Return [H, W] bool, the pixels of a photo that training uses. data: the view's."""
    used = torch.ones(view.camera.height, view.camera.width, dtype=torch.bool)
    if (alpha := data.get("alpha")) is not None:
        used &= alpha.cpu() >= OPAQUE
    if datamanager.config.photos == "objects" and (labels := view.labels) is not None:
        used &= ((labels != BACKGROUND) & (labels != IGNORE)).cpu()
    return used.numpy()


def _lines(measured: Gains, names: Sequence[str], learned: bool) -> Iterator[str]:
    """Yield messages on the photos' gains. learned: whether photos get transforms of their own."""
    if learned:
        means, tinted = measured.stops.mean(axis=1), measured.spread_of_colors
        balance = f", and their colours by {tinted:.2f} EV besides" if tinted > LEAST_SPREAD else ""
        yield (
            f"The photos differ in exposure by {measured.spread:.2f} EV (standard deviation; {means.min():+.2f} to "
            f"{means.max():+.2f}){balance}: each gets a colour transform of its own, and the scene has the mean "
            "photo's exposure."
        )
    if blind := [name for name, noise in zip(names, measured.noise, strict=True) if np.isinf(noise)]:
        one = len(blind) == 1
        which = f"The photo {blind[0]} shows" if one else f"{len(blind)} photos, the first of them {blind[0]}, show"
        yield (
            f"{which} no point of the scene that is neither black nor burnt out: take {'it' if one else 'them'} out of "
            "the data if nothing can be seen there."
        )
