"""Exposures of photos, learned with the scene: an affine colour transform for each, beside the mean photo's in all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.exposure import Exposures, Gains, gains, sightings
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.losses.reduction import ordered_linear
from beags_plugin.options.schedule import log_linear
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.plugin.views.dataparser import BeagsDataParser
from beags_plugin.surfaces.baking import interpolated
from beags_plugin.surfaces.color import linear_from_srgb
from beags_plugin.system.progress import counted, progress_bar, say
from beags_plugin.views.views import View, in_unit_range

LEAST_SPREAD = 0.05  # EV; photos whose gains differ by less are taken to be of one exposure
CERTAIN = 3.0  # times the noise of a gain, by which the photos' gains must differ to count as different
RATES = 1e-2, 1e-3  # first and last learning rate of the transforms, log-linear, as 3DGS has them
BETAS, EPS = (0.9, 0.999), 1e-15  # of Adam
TOWARDS_START = 0.05  # weight of the squared change of a photo's transform in its step
OPAQUE = 242  # alpha, of 255, from which a pixel of a photo shows the scene
GAMMA, OFFSET = 2.4, 0.055
"""sRGB's curve but for the darkest values: (1 + OFFSET) light^(1 / GAMMA) - OFFSET, so that a gain is an affine map."""


class PhotoExposures:
    """The transforms of V photos while they are learned; their mean over the photos is the identity throughout.

    Each step moves the transform of its photo by the training loss and by a pull towards where it began, as Adam does.
    Every photo has moments and a count of steps of its own, so that how far it moves does not hang on their number.
    """

    def __init__(self, model: SceneModel, exposures: Exposures) -> None:
        self.model = model
        self.affine = exposures.affine.to(model.device).clone().requires_grad_()
        self.start = self.affine.detach().clone()
        self.identity = torch.eye(3, 4).to(self.affine)
        self.moments = torch.zeros(2, *self.affine.shape).to(self.affine)  # Adam's, first and second
        self.steps = torch.zeros(len(self.affine), dtype=torch.long)
        model.exposures = Exposures(exposures.names, self.affine.detach())  # which shares the memory
        self._seen: int | None = None

    def state(self) -> dict[str, Any]:
        """Return where the transforms began, their moments and steps; see ``Resumable``."""
        return {"start": self.start.cpu(), "moments": self.moments.cpu(), "steps": self.steps.clone()}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on with the moments of ``state``; the model has the transforms."""
        self.start, self.moments = state["start"].to(self.start), state["moments"].to(self.moments)
        self.steps = state["steps"].clone()

    def __call__(self, colors: Tensor, photo: int) -> Tensor:
        """Return colours [N, 3] as the photo shows them, with a gradient for its transform."""
        self._seen = photo if torch.is_grad_enabled() else None
        affine = self.affine[photo]
        return ordered_linear(colors, affine[:, :3], affine[:, 3])

    def after_step(self, step: int) -> None:
        """Move the transform of the photo that this step saw by its gradient."""
        gradient = self.affine.grad
        if self._seen is None or gradient is None:
            return
        with torch.no_grad():
            photo = self._seen
            gradient[photo] += 2.0 * TOWARDS_START * (self.affine[photo] - self.start[photo])
            rate = log_linear(*RATES, self.model.schedule.progress(step))
            self.affine[photo] -= rate * self._direction(photo, gradient[photo])
            self.affine -= self.affine.mean(dim=0) - self.identity
        self.affine.grad, self._seen = None, None

    def _direction(self, photo: int, gradient: Tensor) -> Tensor:
        """Return Adam's step [3, 4] of a photo at rate 1."""
        self.steps[photo] += 1
        steps = int(self.steps[photo])
        first, second = self.moments[0, photo], self.moments[1, photo]
        first.lerp_(gradient, 1.0 - BETAS[0])
        second.lerp_(gradient.square(), 1.0 - BETAS[1])
        return (first / (1.0 - BETAS[0] ** steps)) / ((second / (1.0 - BETAS[1] ** steps)).sqrt() + EPS)


def exposures_of_run(model: SceneModel, datamanager: BeagsDataManager) -> PhotoExposures | None:
    """Return the photos' exposures to learn, those of a loaded scene where it has any.

    None where photos have one exposure, and where no tracks of points tell. Those that are wanted all the same begin at
    the identity.
    """
    wanted = model.config.exposure
    if wanted == "off":
        model.exposures = None
        return None
    names = tuple(view.name for view in datamanager.views("train"))
    start = torch.eye(3, 4).repeat(len(names), 1, 1)
    if (known := model.exposures) is not None:
        of_name = dict(zip(known.names, known.affine.cpu(), strict=True))
        of_photos = [of_name.get(name, identity) for name, identity in zip(names, start, strict=True)]
        return PhotoExposures(model, Exposures(names, torch.stack(of_photos)))
    if _of_turning_objects(model, datamanager):
        return None
    if (found := photo_gains(datamanager)) is None:
        return PhotoExposures(model, Exposures(names, start)) if wanted == "on" else None
    learned = wanted == "on" or _differ(found)
    for line in _lines(found, names, learned):
        say(line)
    return _begun(model, names, found) if learned else None


def _begun(model: SceneModel, names: tuple[str, ...], found: Gains) -> PhotoExposures:
    """Return transforms that begin at the gains of photos."""
    start = torch.eye(3, 4).repeat(len(names), 1, 1)
    factors = torch.from_numpy(_factors(found)).float()
    start[:, range(3), range(3)] = factors
    start[:, :, 3] = OFFSET * (factors - 1.0)
    return PhotoExposures(model, Exposures(names, start))


def _of_turning_objects(model: SceneModel, datamanager: BeagsDataManager) -> bool:
    """Return whether photos differ because objects turn in a light that stands, and nobody asked for exposures."""
    return model.config.exposure == "auto" and datamanager.config.photos == "objects"


def photo_gains(datamanager: BeagsDataManager) -> Gains | None:
    """Return how bright the training photos show the points that tracks say they share; None without any."""
    tracks = cast(BeagsDataParser, datamanager.dataparser).tracks("train")
    if not any((ids >= 0).any() for ids, _ in tracks):
        return None
    places, light = [], []
    with progress_bar("Comparing exposures", passing=True) as progress:
        for index, view in enumerate(counted(datamanager.views("train"), len(tracks), progress)):
            held = view.data()
            image = in_unit_range(held["image"]).cpu()
            ids, shares = tracks[index]
            xy = datamanager.files["train"].straightened(shares, index)[1]
            inside = ((xy >= 0) & (xy < image.shape[1::-1])).all(axis=1)  # Without its lens a photo shows less.
            inside[inside] = _shown(view, held, datamanager)[tuple(xy[inside].astype(np.int64).T[::-1])]
            places.append(np.where(inside, ids, -1))
            light.append(linear_from_srgb(interpolated(image, xy)))
    return gains(sightings(places, light), len(tracks))


def _shown(view: View, held: dict[str, Tensor], datamanager: BeagsDataManager) -> np.ndarray:
    """Return [H, W] bool, where a photo whose data are ``held`` shows what training sees."""
    shown = torch.ones(view.camera.height, view.camera.width, dtype=torch.bool)
    if (alpha := held.get("alpha")) is not None:
        shown &= alpha.cpu() >= OPAQUE
    if datamanager.config.photos == "objects" and (labels := view.labels) is not None:
        shown &= ((labels != BACKGROUND) & (labels != IGNORE)).cpu()
    return shown.numpy()


def _differ(found: Gains) -> bool:
    """Return whether photos differ in exposure or white balance by more than noise explains."""
    spread = max(found.spread, found.spread_of_colors)
    return spread > max(LEAST_SPREAD, CERTAIN * float(np.median(found.noise)))


def _lines(found: Gains, names: Sequence[str], learned: bool) -> Iterator[str]:
    """Yield what the user should know about the photos' gains. learned: whether photos get transforms of their own."""
    if learned:
        yield _difference(found)
    if blind := [name for name, noise in zip(names, found.noise, strict=True) if np.isinf(noise)]:
        one = len(blind) == 1
        which = f"The photo {blind[0]} shows" if one else f"{len(blind)} photos, the first of them {blind[0]}, show"
        yield (
            f"{which} no point of the scene that is neither black nor burnt out: take {'it' if one else 'them'} out of "
            "the data if nothing can be seen there."
        )


def _difference(found: Gains) -> str:
    """Return the sentence about photos that get transforms."""
    means = found.stops.mean(axis=1)
    tinted = found.spread_of_colors
    balance = f", and their colours by {tinted:.2f} EV besides" if tinted > LEAST_SPREAD else ""
    return (
        f"The photos differ in exposure by {found.spread:.2f} EV (standard deviation; {means.min():+.2f} to "
        f"{means.max():+.2f}){balance}: each gets a colour transform of its own, and the scene has the mean "
        "photo's exposure."
    )


def _factors(found: Gains) -> np.ndarray:
    """Return [V, 3], the slopes that gains give to the photos' values, each with a mean of 1 over the photos."""
    factors = 2.0 ** (found.stops / GAMMA)
    return factors / factors.mean(axis=0)
