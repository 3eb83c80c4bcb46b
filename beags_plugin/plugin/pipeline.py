"""nerfstudio's pipeline, also in one of several processes."""

from __future__ import annotations

from typing import Any, Literal, cast

from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig

from beags_plugin.plugin.options.model_options import BeagsModelConfig
from beags_plugin.plugin.views.datamanager import BeagsDataManagerConfig
from beags_plugin.system.errors import print_user_errors_plainly


class BeagsPipeline(VanillaPipeline):
    """``VanillaPipeline`` without torch's ``DistributedDataParallel``, which keeps to the parameters it was made with.

    Ours change in number as the scene grows: ``training.optimizers`` averages their gradients, and
    ``training.replicas`` does the rest.
    """

    def __init__(
        self,
        config: VanillaPipelineConfig,
        device: str,
        test_mode: Literal["test", "val", "inference"] = "val",
        world_size: int = 1,
        local_rank: int = 0,
        **others: Any,
    ) -> None:
        print_user_errors_plainly()
        model = cast(BeagsModelConfig, config.model)
        data = cast(BeagsDataManagerConfig, config.datamanager)
        data.begins = test_mode == "val" and model.base_steps > 0 and model.start_from is None
        super().__init__(config, device, test_mode, world_size=1, local_rank=local_rank, **others)
