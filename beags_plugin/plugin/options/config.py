"""The base config that every preset overrides, and the trainer config that it is made of."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePath
from typing import Annotated, Any, cast

import torch
import yaml
from nerfstudio.configs.base_config import LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from tyro.conf import Suppress

from beags_plugin.options.loss_spec import LossSpec
from beags_plugin.options.run_format import CONFIG_FILE, RUN_FORMAT
from beags_plugin.plugin.options import rollback
from beags_plugin.plugin.options.machine import check_machine, default_device
from beags_plugin.plugin.options.model_options import BeagsModelConfig
from beags_plugin.plugin.options.relocated import place_for_nerfstudio
from beags_plugin.plugin.views.datamanager import BeagsDataManagerConfig
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.runs.run_config import BEGINNINGS, MOVED, other_format
from beags_plugin.system.errors import UserError, print_user_errors_plainly, writing
from beags_plugin.system.interrupts import stop
from beags_plugin.system.lock import lock_ahead
from beags_plugin.system.output_option import OUTPUT_DIR
from beags_plugin.system.pasted import quoted
from beags_plugin.system.registry import load
from beags_plugin.system.whole_files import write_text_atomically


def _adam_fuses_on_cpus() -> bool:
    """Return whether torch's Adam has the one-pass form on CPUs: from 2.4 on."""
    major, minor = torch.__version__.split(".")[:2]
    return (int(major), int(minor)) >= (2, 4)


class _ConfigDumper(yaml.Dumper):
    """PyYAML's writer of Python objects; a path is one word, so that people can read and edit it."""

    def path(self, path: PurePath) -> yaml.Node:
        tag = f"tag:yaml.org,2002:python/object/apply:pathlib.{type(path).__name__}"
        return self.represent_sequence(tag, [str(path)], flow_style=True)


_ConfigDumper.add_multi_representer(PurePath, _ConfigDumper.path)


def config_text(config: BeagsTrainerConfig) -> str:
    """Return the content of config.yml, which nerfstudio's loader reads too."""
    return yaml.dump(config, Dumper=_ConfigDumper, width=10_000)  # A long path stays on its line.


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Options of one group of parameters in the scene's AdamW, which updates each parameter in one pass."""

    fused: Suppress[bool] = field(default_factory=_adam_fuses_on_cpus)


@dataclass
class BeagsTrainerConfig(TrainerConfig):
    """A nerfstudio trainer config whose paths are absolute once it is saved."""

    _target: type = field(default_factory=lambda: load("beags_plugin.plugin.trainer:BeagsTrainer"))
    prompt: Suppress[str | None] = None  # It is for fields made from text.
    output_dir: Annotated[Path, OUTPUT_DIR] = Path("outputs")
    """Folder of all runs: see run_dir."""
    run_dir: Path | None = None
    """Folder of this run; None puts it where nerfstudio does (output_dir/experiment/method/timestamp)."""
    overwrite: bool = False
    """Replace the run in the folder; without this option, a folder that holds a checkpoint is refused."""
    max_num_iterations: int = 0
    """Step of the schedule to stop after; 0 runs base_steps + refine_steps."""
    check_memory: bool = True
    """Refuse to begin if hardly any memory or disk is free; save and stop when memory runs out (on a CPU)."""

    steps_per_objects: int = 500
    """Steps between two measurements of extracted masks on four held-out views, with a picture of every object alone,
    for tensorboard or wandb, from the first step with classes to the last; 0: never."""

    run_format: Suppress[int] = RUN_FORMAT
    """Version of the run's files."""

    @property
    def model_config(self) -> BeagsModelConfig:
        """Options of the model, with their own type."""
        return cast(BeagsModelConfig, self.pipeline.model)

    @property
    def data_config(self) -> BeagsDataManagerConfig:
        """Options of the data manager, with their own type."""
        return cast(BeagsDataManagerConfig, self.pipeline.datamanager)

    @property
    def data_path(self) -> Path:
        """The folder (or transforms .json) of the training data: --data, or the data parser's own."""
        return Path(self.data_config.data or self.data_config.dataparser.data)

    def text_in(self, folder: Path) -> str:
        """Return the text of the config.yml of a run in ``folder`` made from this one."""
        other = deepcopy(self)
        for name, value in {**dict.fromkeys(BEGINNINGS), "run_dir": folder}.items():
            setattr(other, name, value)
        return config_text(other)

    def check(self) -> None:
        """Raise ``UserError`` for a value with which training cannot run."""
        if self.max_num_iterations < 0:
            raise UserError(f"--max-num-iterations is {self.max_num_iterations}: give a number of steps, 0 for all.")
        if self.steps_per_save < 1:
            raise UserError(f"--steps-per-save is {self.steps_per_save}: give a number of steps, 1 or more.")
        self.model_config.check()

    def get_base_dir(self) -> Path:
        """Return the folder of the run."""
        return self.run_dir if self.run_dir is not None else super().get_base_dir()

    def set_timestamp(self) -> None:
        """Set the time in the folder's name; check the devices before, as nerfstudio calls this first for a new run."""
        try:
            check_machine(self.machine)
        except UserError as error:
            stop(error)
        super().set_timestamp()

    def print_to_terminal(self) -> None:
        """Print nothing; nerfstudio would print 250 lines, which config.yml has too."""

    def save_config(self) -> None:
        """Save config.yml, the first file of a run, with absolute paths; exit if another process trains there."""
        try:
            with writing(run := self.get_base_dir()):
                rollback.note(run)
            lock_ahead(run)
            try:
                self._check_place(run)
                self._save()
            except UserError:
                rollback.noted(run).undo()
                raise
        except UserError as error:
            stop(error)

    def continues(self, run: Path) -> bool:
        """Return whether the training loads a checkpoint of ``run``, the folder that it writes to."""
        loaded = self.load_dir or (self.load_checkpoint and Path(self.load_checkpoint).parent)
        return loaded is not None and Path(loaded).resolve().parent == run.resolve()

    def _check_place(self, run: Path) -> None:
        """Raise ``UserError`` if this run would replace the checkpoints of another one."""
        saved = [*run.glob(f"{self.relative_model_dir}/*.ckpt"), *run.glob(f"{rollback.REPLACED}/*.ckpt")]
        if saved and not (self.continues(run) or self.overwrite):
            raise UserError(
                f"{run} holds a run: go on with it (beags resume {quoted(run)}), replace it (--overwrite True), or "
                "choose another --run-dir."
            )
        self.overwrite = False  # Once saved, it would also apply to every later ns-train --load-config.

    def _save(self) -> None:
        self.output_dir = Path(self.output_dir).absolute()
        for name in ("run_dir", "load_dir", "load_checkpoint"):
            if (path := getattr(self, name)) is not None:
                setattr(self, name, Path(path).absolute())
        if self.data_config.data is not None:  # Nerfstudio copies it to the data parser when a run begins.
            self.data_config.dataparser.data = self.data_config.data
        for holder in (self, self.data_config, self.data_config.dataparser):
            if (data := getattr(holder, "data", None)) is not None:
                holder.data = Path(data).absolute()
        if (start := self.model_config.start_from) is not None:
            self.model_config.start_from = Path(start).absolute()
        write_text_atomically(config_text(self), self.get_base_dir() / CONFIG_FILE)


def _read_by_nerfstudio(loader: yaml.constructor.SafeConstructor, node: yaml.Node) -> Iterator[BeagsTrainerConfig]:
    """Build a config that an ns-* command reads, with the place where its run lies now; reject another format."""
    assert isinstance(node, yaml.MappingNode)
    version = next((loader.construct_object(value) for key, value in node.value if key.value == "run_format"), None)
    if version != RUN_FORMAT:
        print_user_errors_plainly()
        raise other_format("this run", version)
    config = BeagsTrainerConfig.__new__(BeagsTrainerConfig)
    yield config
    config.__dict__.update(cast(dict[str, Any], loader.construct_mapping(node, deep=True)))
    place_for_nerfstudio(config)


for _module in (__name__, "beags_plugin.plugin.config"):  # Runs of the first format name the second.
    _tag = f"tag:yaml.org,2002:python/object:{_module}.BeagsTrainerConfig"
    yaml.add_constructor(_tag, _read_by_nerfstudio, yaml.Loader)
for _former, _kind in MOVED.items():
    _build = partial(yaml.constructor.SafeConstructor.construct_yaml_object, cls=_kind)
    yaml.add_constructor(f"tag:yaml.org,2002:python/object:{_former}", _build, yaml.Loader)


def base_config() -> BeagsTrainerConfig:
    """Return the documented base config: the full schedule (method, sections 1 and 7; 33,000 steps).

    Learning rates, losses and schedules are those of the 2DGS and BEA-GS papers; a preset states what it changes.
    """
    return BeagsTrainerConfig(
        method_name="beags",
        steps_per_eval_batch=0,
        steps_per_eval_image=500,
        steps_per_eval_all_images=0,
        steps_per_save=2000,
        pipeline=VanillaPipelineConfig(
            _target=load("beags_plugin.plugin.pipeline:BeagsPipeline"),
            datamanager=BeagsDataManagerConfig(
                dataparser=BeagsDataParserConfig(),
                cache_images="gpu",  # Nerfstudio means the model's device; "cpu" would pin memory.
                cache_images_type="uint8",
            ),
            model=BeagsModelConfig(
                losses={
                    "photometric": LossSpec(),
                    "distortion": LossSpec(weight=0.0, start=3_000),
                    "normal": LossSpec(weight=0.05, start=7_000),
                    "boundary": LossSpec(weight=0.5, phase="refine"),
                    "silhouette": LossSpec(weight=0.0, phase="refine", options={"objects": 1, "seen": 0}),
                    "occupancy": LossSpec(weight=10.0, phase="refine", options={"samples": 20, "background": 1.0}),
                },
            ),
        ),
        optimizers={
            # Adam is built with these rates; those of positions then follow BeagsModelConfig.position_lr.
            name: {"optimizer": FusedAdamConfig(lr=rate, eps=1e-15), "scheduler": None}
            for name, rate in {
                "means": 1.6e-4,
                "features_dc": 2.5e-3,
                "features_rest": 1.25e-4,
                "opacities": 0.05,
                "scales": 0.005,
                "quats": 0.001,
            }.items()
        },
        machine=MachineConfig(device_type=default_device()),  # type: ignore[arg-type]
        logging=LoggingConfig(steps_per_log=10),
        viewer=ViewerConfig(websocket_host="127.0.0.1", quit_on_train_completion=True),
        vis="viewer+tensorboard",
    )
