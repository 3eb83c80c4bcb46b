"""nerfstudio's pipeline, also in one of several processes."""

from __future__ import annotations

from typing import Any

from nerfstudio.pipelines.base_pipeline import VanillaPipeline

from beags_plugin.system.errors import print_user_errors_plainly


class BeagsPipeline(VanillaPipeline):
    """``VanillaPipeline`` without torch's ``DistributedDataParallel``, which keeps to the parameters it was made with.

    Ours change in number as the scene grows: ``training.optimizers`` averages their gradients, and
    ``training.replicas`` does the rest.
    """

    def __init__(self, *args: Any, world_size: int = 1, local_rank: int = 0, **kwargs: Any) -> None:
        print_user_errors_plainly()
        super().__init__(*args, world_size=1, local_rank=local_rank, **kwargs)
