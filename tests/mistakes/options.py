"""Options that nothing can work with, and what is not there: devices, backends, experiments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mistakes.table import Place, mistake, mistakes, ns_train


def trained(*flags: str, preset: str = "beags-tiny", **settings: Any) -> Callable[[Place], Any]:
    return lambda at: at.train(*flags, preset=preset, **settings)


def beags(*words: object) -> Callable[[Place], Any]:
    return lambda at: at.beags(*words)


def model(flag: str, value: str) -> Callable[[Place], Any]:
    return trained(f"--pipeline.model.{flag}", value)


def refiner(name: str) -> Callable[[Place], Any]:
    """Return the mistake to name a refiner where no other package adds any."""

    def make(at: Place):
        from beags_plugin.refiners import REFINERS

        own = {each: spec for each, spec in REFINERS._specs.items() if spec.startswith("beags_plugin.")}
        at.patch.setattr(REFINERS, "_specs", own)
        at.patch.setattr(REFINERS, "_discovered", True)
        return at.train("--pipeline.model.refiner", name)

    return make


mistakes(
    "options",
    {
        "an unknown backend": model("rasterizer", "vulkan"),
        "an unknown refiner": refiner("magic"),
        "a refiner of a package that is not installed": refiner("flashsplat"),
        "an unknown reprojection": model("prepare.reprojection", "guess"),
        "an unknown kind of depth": model("prepare.depth", "mean"),
        "negative steps of refinement": model("refine-steps", "-5"),
        "no steps at all": trained("--pipeline.model.base-steps", "0", "--pipeline.model.refine-steps", "0"),
        "a negative step to stop at": trained(max_num_iterations=-3),
        "k is 0": model("prepare.k", "0"),
        "k is negative": model("prepare.k", "-1"),
        "tau is not a number": model("prepare.tau", "nan"),
        "a degree of 9": model("sh-degree", "9"),
        "a degree of -1": model("sh-degree", "-1"),
        "a degree every 0 steps": model("sh-degree-interval", "0"),
        "a near plane that is not a number": model("near", "nan"),
        "a near plane behind the far one": model("near", "1e9"),
        "a negative near plane": model("near", "-1"),
        "growth every 0 steps": model("densify.every", "0"),
        "a checkpoint every 0 steps": trained(steps_per_save=0),
        "a downscale factor below 1": trained("beags-data", "--downscale-factor", "0.5"),
        "a downscale factor that leaves no pixel": trained("beags-data", "--downscale-factor", "100"),
        "a scale factor that is not a number": trained("beags-data", "--scale-factor", "nan"),
        "a scale factor of 0": trained("beags-data", "--scale-factor", "0"),
        "every view held out": trained("beags-data", "--eval-interval", "1"),
        "a negative interval of held-out views": trained("beags-data", "--eval-interval", "-2"),
        "a held-out view that does not exist": trained("beags-data", "--held-out", "nobody"),
        "an id to ignore that is none": trained("beags-data", "--ignore-ids", "-1"),
        "no random points": trained("beags-data", "--num-random-points", "0"),
        "a negative number of random points": trained("beags-data", "--num-random-points", "-5"),
        "a device that is not there": trained("--machine.device-type", "cuda"),
        "several devices": trained("--machine.num-devices", "2"),
        "no device": trained("--machine.num-devices", "0"),
        "a learning rate that is not a number": trained("--pipeline.model.position-lr", "nan", "nan"),
    },
)


def loss(name: str, **values: Any) -> Callable[[Place], Any]:
    """Return a mistake in the losses of the config, as a package of one's own would make it."""

    def make(at: Place):
        from beags_plugin.options.loss_spec import LossSpec

        config = at.config()
        spec = config.model_config.losses.get(name, LossSpec())
        config.model_config.losses[name] = LossSpec(**{**vars(spec), **values})
        return lambda: ns_train(config)

    return make


mistakes(
    "options",
    {
        "an unknown loss": loss("beauty"),
        "an unknown option of a loss": loss("photometric", options={"ssim_wait": 1}),
        "a negative weight": loss("boundary", weight=-1.0),
        "a weight that is not a number": loss("boundary", weight=float("nan")),
        "an infinite weight": loss("boundary", weight=float("inf")),
        "an unknown phase": loss("boundary", phase="later"),
        "a loss that begins before the first step": loss("normal", start=-5),
        "no samples": loss("occupancy", options={"samples": 0}),
        "samples that are negative": loss("occupancy", options={"samples": -1}),
        "more than the weight on the background": loss("occupancy", options={"background": 1.5}),
    },
)


@mistake("options", "a backend that was not built")
def _(at: Place):
    from beags_plugin.ops import extension

    reason = "the compiled module was not built: install a C++17 compiler, then run make clean setup."
    at.patch.setattr(extension, "load", lambda: None)
    at.patch.setattr(extension, "status", lambda: (None, reason))
    return at.train("--pipeline.model.rasterizer", "native")


EXPORT, EVAL, RENDER = (f"{name} --load-config {{run}}" for name in ("export", "eval", "render"))
mistakes(
    "export",
    {
        "a truncation that is not a number": beags(EXPORT, "--object cup --format glb --truncation nan"),
        "an unknown object": beags(EXPORT, "--object spoon"),
    },
)
mistake("evaluation", "no worst masks")(beags(EVAL, "--worst 0"))
PATH = '{"camera_type": "perspective", "render_width": 32, "render_height": 24, "fps": 24, "camera_path": []}'


def along(text: str, *words: str) -> Callable[[Place], Any]:
    def make(at: Place):
        (path := at.root / "flight.json").write_text(text)
        return at.beags(RENDER, "--camera-path", path, *words)

    return make


mistakes(
    "pictures",
    {
        "a comparison called .txt": beags(RENDER, "--format before-after --output a.txt"),
        "no frames": beags(RENDER, "--frames 0"),
        "an absent camera path": beags(RENDER, "--camera-path flight.json"),
        "a camera path of another kind": along('{"frames": []}'),
        "a camera path of panoramas": along(PATH.replace("perspective", "equirectangular")),
        "a camera path without cameras": along(PATH),
        "frames along a camera path": along(PATH, "--frames 5"),
        "a sheet along a camera path": along(PATH, "--format sheet"),
        "a sheet without views": beags(RENDER, "--format sheet --views 0"),
    },
)
mistake("sample", "a family that does not exist")(beags("sample --family attic --output out"))
mistake("sample", "no views")(beags("sample --views 0 --output out"))
mistake("sample", "a negative seed")(beags("sample --seed -1 --output out"))
mistake("sample", "a photo of no exposure")(beags("bench sample --exposure nan --output out"))
mistake("sample", "more moved views than views")(beags("bench sample --views 3 --moved 4 --output out"))
mistake("sample", "damage shared by more views than all")(beags("bench sample --shared-damage 1.5 --output out"))
mistake("sample", "pixels that fill no memory")(beags("sample --width 10000000 --height 10000000 --output out"))
mistake("demo", "an empty folder")(lambda at: at.beags("demo --data", (at.root / "empty").mkdir() or at.root / "empty"))
mistake("demo", "a downscale factor of 0")(beags("demo --downscale 0 --data {data}"))

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


mistakes(
    "experiments",
    {
        "an unknown entry": experiment("colour = 1\n" + GOOD),
        "an unknown option of a variant": experiment(GOOD + "refine = { 'pipeline.model.beauty' = 1 }"),
        "an option of the wrong type": experiment(GOOD + "refine = { 'pipeline.model.prepare.k' = 'many' }"),
        "an unknown preset": experiment(GOOD.replace("beags-tiny", "beags-huge")),
        "no variant": experiment(GOOD.partition("[[")[0]),
        "two variants of one name": experiment(GOOD + "[[variant]]\nname = 'a'\n"),
        "a variant that is a number": experiment("variant = 3\n" + GOOD.partition("[[")[0]),
        "a reference that is no variant": experiment("reference = 'b'\n" + GOOD),
        "a sweep without values": experiment(GOOD + "[[sweep]]\nname = 's'\nkey = 'damage'\n"),
        "a damage that is no degree": experiment(GOOD + "damage = 'heavy'\n"),
        "TOML broken": experiment("description = "),
        "not UTF-8": experiment(b"description = '\xff'"),
        "data that do not exist": experiment(GOOD, "--data nowhere"),
    },
)
