"""What happens around training steps: schedules, densification, and the switch to refinement."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from torch import Tensor

from beags_plugin.core.densification import GradientStatistics, densify, length_units, reset_opacity
from beags_plugin.plugin.options.schedule import log_linear
from beags_plugin.plugin.training.refinement import RefinementSwitch
from beags_plugin.plugin.training.scene_edits import edit_scene, move_adam_state
from beags_plugin.system import processes

if TYPE_CHECKING:
    from beags_plugin.plugin.model import BeagsModel, BeagsModelConfig
    from beags_plugin.plugin.trainer import BeagsTrainer
    from beags_plugin.plugin.training.curves import Curves
    from beags_plugin.plugin.views.datamanager import BeagsDataManager

EXTENT_MARGIN = 1.1  # the scene's extent is 1.1 x the largest distance of a camera from their mean (section 1)


def training_callbacks(model: BeagsModel, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:
    """The callbacks of one run, in the order in which nerfstudio calls them."""
    trainer, pipeline = cast("BeagsTrainer", attributes.trainer), attributes.pipeline
    assert pipeline is not None and attributes.optimizers is not None
    datamanager = cast("BeagsDataManager", pipeline.datamanager)
    optimizers = attributes.optimizers.optimizers
    model.seed = trainer.config.machine.seed
    model.extent = camera_extent(datamanager.train_dataset.cameras.camera_to_worlds).to(model.device)
    cameras = datamanager.train_dataset.cameras
    pixels = int((cameras.height * cameras.width).sum())
    densifier = Densifier(model, optimizers, pixels, cameras.camera_to_worlds[:, :3, 3])
    switch = RefinementSwitch(model, trainer, datamanager)
    switch.check_options()
    switch.check_masks()
    model.viewing.rounds = lambda: switch.rounds if switch.ready else 0
    for name, part in {"views": datamanager, "densification": densifier, "refinement": switch}.items():
        trainer.keep(name, part)

    curves = _curves(model, trainer, datamanager)
    if curves is not None:
        trainer.keep("curves", curves)

    def before(step: int) -> None:
        trainer.stop_if_asked(step)
        model.step = step
        every = trainer.config.logging.steps_per_log
        model.measuring = every > 0 and step % every == 0  # nerfstudio reads no other step's
        densifier.before_step(step)
        switch.before_step(step)
        if curves is not None:
            curves.before_step(step)
        model.clock.start()
        set_learning_rates(model, optimizers, trainer.config.optimizers, step)

    def after(step: int) -> None:
        densifier.after_step(step)
        model.clock.mark("growth")
        switch.after_step(step)
        if curves is not None:
            curves.after_step(step)

    return [
        TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], before),
        TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], after),
    ]


def _curves(model: BeagsModel, trainer: BeagsTrainer, datamanager: BeagsDataManager) -> Curves | None:
    """What writes this run's curves; None where nobody would read them."""
    from beags_plugin.plugin.training.curves import Curves
    from beags_plugin.plugin.views.held_out_views import HeldOutViews

    config = trainer.config
    if not (config.is_tensorboard_enabled() or config.is_wandb_enabled() or config.is_comet_enabled()):
        return None
    views = HeldOutViews(config, model.classes, datamanager)
    return Curves(model, views, config.steps_per_objects, trainer.last_step, config.logging.steps_per_log)


def camera_extent(camera_to_worlds: Tensor) -> Tensor:
    """Size of the scene: 1.1 x the largest distance of a camera [V, 3, 4] from the mean of all; 1 for a single one."""
    centers = camera_to_worlds[..., :3, 3].float()
    extent = EXTENT_MARGIN * (centers - centers.mean(dim=0)).norm(dim=-1).max()
    return extent if float(extent) > 0 else torch.ones(())


def set_learning_rates(model: BeagsModel, optimizers: dict, configs: dict, step: int) -> None:
    """Set every group's rate for this step, so that nothing depends on what a checkpoint last held."""
    progress, refining = model.schedule.progress(step), model.schedule.refining(step)
    first = model.schedule.first_rate_factor(model.config.base_lr_power)
    for name, optimizer in optimizers.items():
        rate = configs[name]["optimizer"].lr
        if name == "means":
            rate = log_linear(*model.config.position_lr, progress) * model.extent_on_host()
        rate *= refinement_factor(model.config, name) if refining else log_linear(first, 1.0, progress)
        for group in optimizer.param_groups:
            group["lr"] = rate


def refinement_factor(config: BeagsModelConfig, group: str) -> float:
    """What a group's learning rate is multiplied with while refining."""
    shape, positions = config.refine_shape_lr_factor, config.refine_position_lr_factor
    return {"means": positions, "scales": shape, "quats": shape}.get(group, 1.0)


class Densifier:
    """Grows and prunes the base by the screen gradients that it gathers.

    pixels: of all training images. camera_centers: [V, 3] world.
    """

    def __init__(self, model: BeagsModel, optimizers: dict, pixels: int, camera_centers: Tensor) -> None:
        self.model = model
        self.camera_centers = camera_centers
        self.config = model.config.densify.scaled(model.schedule.scale).bounded(pixels)
        self.optimizers = optimizers
        self.statistics = GradientStatistics(model.num_points, model.device)

    def state(self) -> dict[str, Any]:
        """What was gathered since the scene last grew, as long as it grows; see ``training_state.Part``."""
        found = self.statistics if self.model.growing else GradientStatistics(0)
        return {"total": found.total, "views": found.views}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on gathering, in the first process alone: what the others had gathered is not in a checkpoint."""
        if processes.rank() == 0 and len(state["total"]) == self.model.num_points:
            kept = self.statistics
            kept.total, kept.views = state["total"].clone().to(kept.total), state["views"].clone().to(kept.views)

    def before_step(self, step: int) -> None:
        """Let the step be drawn with what is gathered, as long as the scene still grows; a trained one does not."""
        schedule = self.model.schedule
        self.model.growing = not schedule.warm and step + 1 < min(self.config.stop, schedule.base_steps)

    def after_step(self, step: int) -> None:
        """Gather; densify and reset opacities when their step has come."""
        config, drawn = self.config, self.model.drawn
        done = step + 1
        if not self.model.growing or drawn is None:
            return
        if drawn.screen_shift is not None and drawn.screen_shift.grad is not None:
            self.statistics.add(drawn.screen_shift.grad.norm(dim=-1), drawn.render.visible)
        if config.grows_at(done):
            self._densify(done)
        if config.resets_at(done):
            self._reset_opacity()

    def _densify(self, step: int) -> None:
        model = self.model
        # drawn from (seed, step), so that a resumed run draws what the uninterrupted one did
        generator = torch.Generator().manual_seed(model.seed * 1_000_003 + step)
        surfels = model.surfels().detach()
        processes.add_up([self.statistics.total, self.statistics.views])
        units = length_units(surfels.means, self.camera_centers, float(model.extent), self.config)
        edited = densify(surfels, self.statistics.mean(), units, self.config, step, generator)
        edit_scene(model, self.optimizers, edited)
        self.statistics = GradientStatistics(model.num_points, model.device)
        model.drawn = None

    def _reset_opacity(self) -> None:
        model = self.model
        logits = reset_opacity(model.surfels().detach())
        parameter = model.gauss_params["opacities"]
        parameter.data = logits[:, None].contiguous()
        everyone = torch.arange(logits.shape[0])
        start_anew = torch.ones_like(everyone, dtype=torch.bool)
        move_adam_state(self.optimizers["opacities"], parameter, parameter, everyone, start_anew)
