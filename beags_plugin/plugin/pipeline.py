"""nerfstudio's pipeline, whose data manager knows whether a base begins."""

from __future__ import annotations

from typing import Any, Literal, cast

from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig

from beags_plugin.plugin.options.model_options import BeagsModelConfig
from beags_plugin.plugin.views.datamanager import BeagsDataManagerConfig
from beags_plugin.system.errors import print_user_errors_plainly


class BeagsPipeline(VanillaPipeline):
    """``VanillaPipeline`` that tells its data manager whether a base begins, and prints user errors as sentences."""

    def __init__(
        self,
        config: VanillaPipelineConfig,
        device: str,
        test_mode: Literal["test", "val", "inference"] = "val",
        *rest: Any,
        **others: Any,
    ) -> None:
        print_user_errors_plainly()
        model = cast(BeagsModelConfig, config.model)
        data = cast(BeagsDataManagerConfig, config.datamanager)
        data.begins = test_mode == "val" and model.base_steps > 0 and model.start_from is None
        super().__init__(config, device, test_mode, *rest, **others)
