"""Render the pictures that nerfstudio requests from a model, and further ones for its viewer."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from nerfstudio.viewer.render_state_machine import RenderStateMachine
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.viewer.choice import Choice, Visible, visible_part
from beags_plugin.plugin.viewer.pace import Pace
from beags_plugin.plugin.viewer.pictures import (
    boundary_picture,
    class_picture,
    fitted_camera,
    framed,
    nearest_view,
)
from beags_plugin.rasterizers.rendering import render_class_map, surfel_inputs
from beags_plugin.system.errors import UserError

if TYPE_CHECKING:
    from nerfstudio.data.scene_box import OrientedBox

    from beags_plugin.plugin.viewer.errand import Errand
    from beags_plugin.plugin.viewer.viewed_run import ViewedRun

CHANNELS = {
    "class_map": 3,
    "class_confidence": 1,
    "boundary_error": 1,
    "mask_before": 3,
    "mask_after": 3,
}
"""Additional pictures: name to number of channels."""
OF_TRAINING_VIEWS = frozenset({"boundary_error", "mask_before", "mask_after"})
PATIENCE = 5.0  # Seconds that a click waits for the scene.
NO_CLASSES = "the Gaussians have no classes yet: they get them between base training and refinement."


def called_by_viewer() -> bool:
    """Return whether nerfstudio's viewer calls; evaluation and ns-render get the whole scene."""
    return isinstance(threading.current_thread(), RenderStateMachine)


def scene_outputs(model: SceneModel, camera: Camera) -> dict[str, Tensor]:
    """Render the whole scene (inside nerfstudio's crop box), for evaluation, ns-render and ns-export.

    Each [H, W, 1 or 3] float32: rgb, depth (world units along z), normal, accumulation, background; with classes also
    class_map (colours) and class_confidence (the winner's share).
    """
    scene = visible_part(model.surfels(), model.members(), Choice(), inside=within(model, model.crop_box))
    outputs = plain_outputs(model, scene, camera, model.background_color)
    if bool(model.assigned):
        outputs.update(class_outputs(model, scene, camera))
    return outputs


@dataclass(frozen=True)
class Paint:
    """Colours of picked objects over those of the scene of N Gaussians.

    colors: [N, 3] float32. strength: [N] float32, 0..1, of the colour. only: [N] bool, the Gaussians to render; None:
    all.
    """

    colors: Tensor
    strength: Tensor
    only: Tensor | None = None


def plain_outputs(
    model: SceneModel, scene: Visible, camera: Camera, background: Tensor, paint: Paint | None = None
) -> dict[str, Tensor]:
    """Render the pictures that every run has: see ``scene_outputs``."""
    background = background.to(model.device)
    inputs = surfel_inputs(scene.surfels, camera, model.active_sh_degree())
    if paint is not None:
        index = slice(None) if scene.index is None else scene.index
        inputs = replace(inputs, colors=inputs.colors.lerp(paint.colors[index], paint.strength[index][:, None]))
    render = model.rasterizer.rasterize(inputs, camera, model.settings(), background)
    assert render.depth is not None and render.normal is not None
    return {
        "rgb": render.color.clamp(0.0, 1.0),
        "depth": render.depth[..., None],
        "normal": 0.5 - 0.5 * render.normal,  # Surfaces facing the camera look bluish, as in other viewers.
        "accumulation": render.alpha[..., None],
        "background": background.expand(camera.height, camera.width, 3),
    }


def class_outputs(model: SceneModel, scene: Visible, camera: Camera) -> dict[str, Tensor]:
    """Render the class of each pixel, in its colour, and its share of the pixel."""
    classes, share = render_class_map(model.rasterizer, scene.surfels, scene.class_ids, camera, model.settings())
    return {"class_map": class_picture(classes), "class_confidence": share[..., None].float()}


def is_prepared(model: SceneModel) -> bool:
    """Return whether the present scene was prepared for refinement; a loaded checkpoint was if it has classes."""
    return bool(model.assigned) if model.prepared is None else model.prepared


def within(model: SceneModel, box: OrientedBox | None) -> Tensor | None:
    """Return [N] bool, the Gaussians in nerfstudio's crop box; None without one."""
    return None if box is None else box.within(model.means).reshape(-1)


class Viewing:
    """Renders the pictures of a model for a viewer.

    The panel's threads set ``choice``; the viewer's render threads call ``outputs``. Nerfstudio raises an exception
    between any two lines of an obsolete rendering, and any other exception ends the render thread for good. So a
    rendering stores its results by one assignment, and a failure becomes a note.

    background: [3], the viewer's. listed: names of ``CHANNELS`` that this run offers, fixed as long as a viewer runs.
    requested: returns those that are visible now. crop_box: returns the viewer's. run: the run's files. notes: remarks
    on the pictures of the last rendering. pace: of the rendering. paint: of the picked objects. errand: objects to pick
    for a waiting program.
    """

    def __init__(self, model: SceneModel) -> None:
        self.model = model
        self.choice = Choice()
        self.background: Tensor | None = None
        self.listed: tuple[str, ...] = ()
        self.requested: Callable[[], frozenset[str]] = frozenset
        self.crop_box: Callable[[], OrientedBox | None] = lambda: None
        self.run: ViewedRun | None = None
        self.notes: dict[str, str] = {}
        self.pace = Pace()
        self.paint: Paint | None = None
        self.errand: Errand | None = None
        self.lock = threading.Lock()

    def attach(self, run: ViewedRun, training: bool, lock: threading.Lock | None) -> None:
        """Connect to a viewer.

        run: parts of the run besides its scene. training: whether it is being trained. lock: held while the scene is
        changed, or rendered for the viewer.
        """
        self.lock = lock or self.lock
        run.refining = lambda: is_prepared(self.model)
        classes = bool(self.model.assigned) or (training and self.model.schedule.refine_steps > 0)
        prepares = training and classes
        available = {
            "class_map": classes,
            "class_confidence": classes,
            "boundary_error": classes and run.has_masks,
            "mask_before": run.has_masks,
            "mask_after": prepares or run.prepared is not None,
        }
        self.run = run
        self.listed = tuple(name for name in CHANNELS if available[name])

    @contextmanager
    def held_soon(self) -> Iterator[None]:
        """Hold the lock in the block; raise ``UserError`` if the scene stays busy."""
        if not self.lock.acquire(timeout=PATIENCE):
            raise UserError("the scene is busy: click again.")
        try:
            yield
        finally:
            self.lock.release()

    def visible(self, rest: bool = True) -> Visible:
        """Return the Gaussians to render by choice and paint; rest: False leaves the faded ones out."""
        model = self.model
        choice = self.choice if bool(model.assigned) else Choice(min_opacity=self.choice.min_opacity)
        inside, paint = within(model, self.crop_box()), self.paint
        if paint is not None and paint.only is not None:
            inside = paint.only if inside is None else inside & paint.only
        return visible_part(model.surfels().detach(), model.members(), choice, rest, inside)

    def outputs(self, camera: Camera) -> dict[str, Tensor]:
        """Render every picture that the viewer lists; those that are not visible at present stay black."""
        model, notes = self.model, {}
        started, worked = time.perf_counter(), time.process_time()
        requested = self.requested() & frozenset(self.listed)
        scene = self.visible()
        background = model.background_color if self.background is None else self.background
        outputs = plain_outputs(model, scene, camera, background, self.paint)
        del outputs["background"]
        black = camera.K.new_zeros(1, 1, 1)
        for name in self.listed:
            outputs[name] = black.expand(camera.height, camera.width, CHANNELS[name])
        if requested & {"class_map", "class_confidence"}:
            if bool(model.assigned):
                outputs.update(class_outputs(model, scene, camera))
            else:
                notes["classes"] = f"No class map: {NO_CLASSES}"
        if names := requested & OF_TRAINING_VIEWS:
            outputs.update(self._of_training_view(names, scene, camera, notes))
        self.notes = notes
        spent = time.perf_counter() - started, time.process_time() - worked
        self.pace.took(camera.width * camera.height, len(scene.surfels), *spent)
        return outputs

    def _of_training_view(
        self, names: frozenset[str], scene: Visible, camera: Camera, notes: dict[str, str]
    ) -> dict[str, Tensor]:
        """Render pictures of the training view nearest to ``camera``, as large as fits into the viewer's picture."""
        model, run = self.model, self.run
        if run is None:
            notes["view"] = "There are no training views: no run is shown."
            return {}
        index = nearest_view(camera, run.cameras, float(model.extent))
        fitted = fitted_camera(run.cameras[index], camera.width, camera.height)
        outputs = {}
        try:
            before, after = (run.mask(index, kind, fitted.width, fitted.height) for kind in ("before", "after"))
        except (UserError, OSError) as error:
            notes["view"] = f"The masks of {run.names[index]} cannot be read: {error}"
            return {}
        notes["view"] = f"{', '.join(sorted(names))}: of training view {run.names[index]}, the nearest."
        for name, mask in (("mask_before", before), ("mask_after", after)):
            if name in names and mask is not None:
                outputs[name] = framed(class_picture(mask), camera.width, camera.height)
            elif name in names:
                notes[name] = f"{run.names[index]} has no {name.replace('_', ' ')} reprojection."
        target = before if after is None else after
        if "boundary_error" in names:
            if target is None or not bool(model.assigned):
                reason = NO_CLASSES if target is not None else "the view has no mask."
                notes["boundary"] = f"No boundary error: {reason}"
            else:
                error = boundary_picture(
                    model.rasterizer, scene.surfels, scene.class_ids, fitted, model.settings(), target
                )
                outputs["boundary_error"] = framed(error, camera.width, camera.height)
        return outputs

    def copy(self, rest: bool = True) -> Visible:
        """Return a copy of ``visible``; waits for the training step, if there is one."""
        with self.lock:
            scene = self.visible(rest)
            return Visible(scene.surfels.clone(), scene.class_ids.clone(), scene.index)

    def whole(self) -> tuple[Surfels, Membership]:
        """Return a copy of the scene and its classes; waits as ``copy`` does."""
        with self.lock:
            members = self.model.members()
            return self.model.surfels().detach().clone(), Membership(members.class_ids.clone(), members.objects)
