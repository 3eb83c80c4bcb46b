"""Callbacks around each training step: learning rates, densification, the switch to refinement, curves."""

from __future__ import annotations

from typing import Any, cast

from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from torch.optim import Adam

from beags_plugin.core.cameras import camera_extent
from beags_plugin.core.schedule import log_linear
from beags_plugin.plugin.training.densifier import Densifier
from beags_plugin.plugin.training.exposure import exposures_of_run
from beags_plugin.plugin.training.monitor import Curves
from beags_plugin.plugin.training.optimizers import SceneOptimizer
from beags_plugin.plugin.training.refinement import RefinementSwitch
from beags_plugin.plugin.training.resumable import TrainingRun
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.views.held_out_views import HeldOutViews


def training_callbacks(model: SceneModel, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:
    """Build the callbacks of one run, in the order in which nerfstudio calls them."""
    trainer, pipeline = cast(TrainingRun, attributes.trainer), attributes.pipeline
    assert pipeline is not None and attributes.optimizers is not None
    datamanager = cast(BeagsDataManager, pipeline.datamanager)
    adam = cast(SceneOptimizer, attributes.optimizers).adam
    model.seed = trainer.config.machine.seed
    model.extent = camera_extent(datamanager.train_dataset.cameras.camera_to_worlds).to(model.device)
    datamanager.focus(trainer.loaded_close_ups)
    densifier = Densifier(model, adam, datamanager)
    switch = RefinementSwitch(model, trainer, datamanager)
    switch.check()
    switch.ask_steps()
    for name, part in {"views": datamanager, "densification": densifier, "refinement": switch}.items():
        trainer.keep(name, part)
    exposure = model.photo_colors = exposures_of_run(model, datamanager)
    if exposure is not None:
        trainer.keep("exposure", exposure)
    curves = _curves(model, trainer, datamanager)
    if curves is not None:
        trainer.keep("curves", curves)

    def before(step: int) -> None:
        trainer.stop_if_requested(step)
        model.step = step
        every = trainer.config.logging.steps_per_log
        model.measuring = every > 0 and step % every == 0  # Nerfstudio reads only these steps' metrics.
        densifier.before_step(step)
        switch.before_step(step)
        if curves is not None:
            curves.before_step(step)
        set_learning_rates(model, adam, trainer.config.optimizers, step)
        own_learning_rates(model, adam, step)

    def after(step: int) -> None:
        if exposure is not None:
            exposure.after_step(step)
        densifier.after_step(step)
        switch.after_step(step)
        if curves is not None:
            curves.after_step(step)

    return [
        TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], before),
        TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], after),
    ]


def _curves(model: SceneModel, trainer: TrainingRun, datamanager: BeagsDataManager) -> Curves | None:
    """Return the writer of this run's curves; None if no program reads them."""
    config = trainer.config
    if not (config.is_tensorboard_enabled() or config.is_wandb_enabled() or config.is_comet_enabled()):
        return None
    views = HeldOutViews(datamanager, model.classes, model.background_color)
    return Curves(model, views, config.steps_per_objects, trainer.last_step, config.logging.steps_per_log)


def own_learning_rates(model: SceneModel, adam: Adam, step: int) -> None:
    """Set the rates of this step to those of a refiner that makes its steps itself."""
    own = model.own_training
    if own is not None and (rates := own.rates(step - model.schedule.base_steps)) is not None:
        for group in adam.param_groups:
            group["lr"] = rates.get(group["name"], 0.0)


def set_learning_rates(model: SceneModel, adam: Adam, configs: dict[str, Any], step: int) -> None:
    """Set every group's rate, decay and eps for this step, since a checkpoint of the base may hold others."""
    progress, refining = model.schedule.progress(step), model.schedule.refining(step)
    from_seeds = not (refining or model.schedule.warm)
    faster = model.config.base_lr_factor if from_seeds else 1.0
    for group in adam.param_groups:
        options = configs[group["name"]]["optimizer"]
        rate, group["weight_decay"], group["eps"] = options.lr, options.weight_decay, options.eps
        if group["name"] == "means":
            rate = log_linear(*model.config.position_lr, progress) * model.extent_on_host()
        group["lr"] = rate if group["name"] == "opacities" else rate * faster
