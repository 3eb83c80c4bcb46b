"""Sources of masks, registered by name (entry points: ``beags.mask_sources``)."""

from beags_plugin.system.registry import Registry

MASK_SOURCES = Registry(
    "mask source",
    "beags.mask_sources",
    {
        "coco": "beags_plugin.masks.sources.coco:CocoSource",
        "cut": "beags_plugin.masks.sources.cut:CutSource",
        "gaussian-grouping": "beags_plugin.masks.sources.id_images:GaussianGroupingSource",
        "id-images": "beags_plugin.masks.sources.id_images:IdImagesSource",
        "object-images": "beags_plugin.masks.sources.object_images:ObjectImagesSource",
        "rembg": "beags_plugin.masks.sources.rembg:RembgSource",
        "salient": "beags_plugin.masks.sources.salient:SalientSource",
        "sam2": "beags_plugin.masks.sources.sam2:Sam2Source",
    },
)
