"""Generated scenes, by family (entry points: ``beags.sample_families``)."""

from beags_plugin.system.registry import Registry

FAMILIES = Registry(
    "generated scene",
    "beags.sample_families",
    {
        "desk": "beags_plugin.sample.desk:DESK",
        "tabletop": "beags_plugin.sample.lighting:TABLETOP",
    },
    others="; those of the experiments come with beags-benchmarks (pip install ./benchmarks in a clone of beags)",
)
