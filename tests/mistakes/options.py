"""Options that nothing can work with, and what is not there: devices, backends, experiments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mistakes.table import Place, mistake


def trained(*flags: str, preset: str = "beags-tiny", **settings: Any) -> Callable[[Place], Any]:
    return lambda at: at.train(*flags, preset=preset, **settings)


def beags(*words: object) -> Callable[[Place], Any]:
    return lambda at: at.beags(*words)


def model(flag: str, value: str) -> Callable[[Place], Any]:
    return trained(f"--pipeline.model.{flag}", value)


mistake("options", "an unknown backend")(model("rasterizer", "vulkan"))
mistake("options", "an unknown refiner")(model("refiner", "magic"))
mistake("options", "an unknown reprojection")(model("prepare.reprojection", "guess"))
mistake("options", "an unknown kind of depth")(model("prepare.depth", "mean"))
mistake("options", "negative steps of refinement")(model("refine-steps", "-5"))
mistake("options", "no steps at all")(trained("--pipeline.model.base-steps", "0", "--pipeline.model.refine-steps", "0"))
mistake("options", "no rounds of refinement")(model("refine-rounds", "0"))
mistake("options", "a negative step to stop at")(trained(max_num_iterations=-3))
mistake("options", "k is 0")(model("prepare.k", "0"))
mistake("options", "k is negative")(model("prepare.k", "-1"))
mistake("options", "tau is not a number")(model("prepare.tau", "nan"))
mistake("options", "a confidence above 1")(model("prepare.min-confidence", "2"))
mistake("options", "a degree of 9")(model("sh-degree", "9"))
mistake("options", "a degree of -1")(model("sh-degree", "-1"))
mistake("options", "a degree every 0 steps")(model("sh-degree-interval", "0"))
mistake("options", "a near plane that is not a number")(model("near", "nan"))
mistake("options", "a near plane behind the far one")(model("near", "1e9"))
mistake("options", "a negative near plane")(model("near", "-1"))
mistake("options", "growth every 0 steps")(model("densify.every", "0"))
mistake("options", "a checkpoint every 0 steps")(trained(steps_per_save=0))
mistake("options", "a downscale factor below 1")(trained("beags-data", "--downscale-factor", "0.5"))
mistake("options", "a downscale factor that leaves no pixel")(trained("beags-data", "--downscale-factor", "100"))
mistake("options", "a scale factor that is not a number")(trained("beags-data", "--scale-factor", "nan"))
mistake("options", "a scale factor of 0")(trained("beags-data", "--scale-factor", "0"))
mistake("options", "every view held out")(trained("beags-data", "--eval-interval", "1"))
mistake("options", "a negative interval of held-out views")(trained("beags-data", "--eval-interval", "-2"))
mistake("options", "a held-out view that does not exist")(trained("beags-data", "--held-out", "nobody"))
mistake("options", "an id to ignore that is none")(trained("beags-data", "--ignore-ids", "-1"))
mistake("options", "no random points")(trained("beags-data", "--num-random-points", "0"))
mistake("options", "a negative number of random points")(trained("beags-data", "--num-random-points", "-5"))
mistake("options", "a device that is not there")(trained("--machine.device-type", "cuda"))
mistake("options", "several processes on a CPU")(trained("--machine.num-devices", "2"))
mistake("options", "no process")(trained("--machine.num-devices", "0"))
mistake("options", "a learning rate that is not a number")(trained("--pipeline.model.position-lr", "nan", "nan"))


def loss(name: str, **values: Any) -> Callable[[Place], Any]:
    """A mistake in the losses of the config, as a package of one's own would make it."""

    def make(at: Place):
        from beags_plugin.plugin.options.loss_spec import LossSpec

        config = at.config()
        spec = config.model_config.losses.get(name, LossSpec())
        config.model_config.losses[name] = LossSpec(**{**vars(spec), **values})
        return at.trained(config)

    return make


mistake("options", "an unknown loss")(loss("beauty"))
mistake("options", "an unknown option of a loss")(loss("photometric", options={"colour": 1}))
mistake("options", "a negative weight")(loss("boundary", weight=-1.0))
mistake("options", "a weight that is not a number")(loss("boundary", weight=float("nan")))
mistake("options", "an infinite weight")(loss("boundary", weight=float("inf")))
mistake("options", "an unknown phase")(loss("boundary", phase="later"))
mistake("options", "a loss that begins before the first step")(loss("normal", start=-5))
mistake("options", "no samples")(loss("occupancy", options={"samples": 0}))
mistake("options", "samples that are negative")(loss("occupancy", options={"samples": -1}))


@mistake("options", "a backend that was not built")
def _(at: Place):
    from beags_plugin.ops import extension

    reason = "the compiled module was not built: install a C++17 compiler, then run make clean setup."
    at.patch.setattr(extension, "load", lambda: None)
    at.patch.setattr(extension, "status", lambda: (None, reason))
    return at.train("--pipeline.model.rasterizer", "native")


mistake("export", "a truncation that is not a number")(
    beags("export --load-config {run} --object cup --format glb --truncation nan")
)
mistake("pictures", "a film called .png")(beags("render --load-config {run} --output film.png"))
mistake("pictures", "no frames")(beags("render --load-config {run} --frames 0"))
mistake("pictures", "a sheet without views")(beags("render --load-config {run} --format sheet --views 0"))
mistake("sample", "no views")(beags("sample --views 0 --output out"))
mistake("sample", "a negative seed")(beags("sample --seed -1 --output out"))
mistake("sample", "pixels that fill no memory")(beags("sample --width 10000000 --height 10000000 --output out"))
mistake("demo", "an empty folder")(lambda at: at.beags("demo --data", (at.root / "empty").mkdir() or at.root / "empty"))
mistake("demo", "a downscale factor of 0")(lambda at: at.beags("demo --downscale 0 --data", at.data))
mistake("mask checks", "a number of views below 1")(lambda at: at.beags("masks check --min-views 0 --data", at.data))
mistake("mask checks", "a folder of masks that does not exist")(
    beags("masks reproject --load-config {run} --masks-path nowhere")
)

GOOD = """
description = "one"
preset = "beags-tiny"
[[variant]]
name = "a"
"""


def experiment(text: str | bytes, *words: str) -> Callable[[Place], Any]:
    def make(at: Place):
        path = at.root / "mine.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return at.beags("bench file", path, "--output", at.root / "bench", *words)

    return make


mistake("experiments", "an unknown entry")(experiment("colour = 1\n" + GOOD))
mistake("experiments", "an unknown option of a variant")(experiment(GOOD + "refine = { 'pipeline.model.beauty' = 1 }"))
mistake("experiments", "an option of the wrong type")(
    experiment(GOOD + "refine = { 'pipeline.model.prepare.k' = 'many' }")
)
mistake("experiments", "an unknown preset")(experiment(GOOD.replace("beags-tiny", "beags-huge")))
mistake("experiments", "no variant")(experiment(GOOD.partition("[[")[0]))
mistake("experiments", "two variants of one name")(experiment(GOOD + "[[variant]]\nname = 'a'\n"))
mistake("experiments", "a variant that is a number")(experiment("variant = 3\n" + GOOD.partition("[[")[0]))
mistake("experiments", "a reference that is no variant")(experiment("reference = 'b'\n" + GOOD))
mistake("experiments", "a sweep without values")(experiment(GOOD + "[[sweep]]\nname = 's'\nkey = 'damage'\n"))
mistake("experiments", "a damage that is no degree")(experiment(GOOD + "damage = 'heavy'\n"))
mistake("experiments", "TOML broken")(experiment("description = "))
mistake("experiments", "not UTF-8")(experiment(b"description = '\xff'"))
mistake("experiments", "data that do not exist")(experiment(GOOD, "--data nowhere"))
mistake("experiments", "no such file")(beags("bench file nowhere.toml --output bench"))
