"""Images and labels at the size of the cameras, for nerfstudio."""

from __future__ import annotations

from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset

from beags_plugin.views.split_photos import SplitPhotos


class BeagsDataset(SplitPhotos, InputDataset):
    """Views of one split, as ``SplitPhotos`` reads them: ``image`` [H, W, 3] and ``labels`` [H, W] uint16.

    scale_factor: the data manager's ``camera_res_scale_factor``; it multiplies the parser's downscale factor.
    """

    cameras: Cameras
    exclude_batch_keys_from_device = ["image", "mask", "labels", "alpha"]

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0) -> None:
        # The factor is not passed on, because nerfstudio rounds the size down but scales K exactly.
        InputDataset.__init__(self, dataparser_outputs)
        if scale_factor != 1.0:
            self.scale_factor = scale_factor
        self.set_sizes(scale_factor)
