"""``beags eval`` on runs on disk: figures and files."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
import pytest
import torch
from data_folders import HEIGHT, WIDTH, write_image, write_transforms
from PIL import Image
from run_folders import discs, write_scene, write_trained
from scipy.ndimage import binary_erosion

pytest.importorskip("nerfstudio")

from distorted_views import BROWN, LARGE_H, LARGE_W, LENS, distort

from beags_plugin.commands.cli import main
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import IMAGE_FIGURES
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.objects.evaluate import EvaluatedRun, evaluate_run
from beags_plugin.objects.extract import extract_objects
from beags_plugin.plugin.model import BeagsModel
from beags_plugin.plugin.options.saved_config import open_for_training
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.system.errors import UserError

RASTER = RasterSettings(0.03, 300.0, geometry=False)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Return config.yml of a run with a base, on data with ground truth at twice the size of the photographs."""
    root = tmp_path_factory.mktemp("lab")
    return write_trained(root / "run", write_scene(root / "lab", truth_factor=2))


def rendered(config, surfels, index: int, background: float = 0.0):
    """Render the colour and alpha of a held-out view."""
    camera = EvaluatedRun(config).views.manager.views("test")[index].camera
    with torch.no_grad():
        inputs = surfel_inputs(surfels, camera)
        return make_rasterizer("auto").rasterize(inputs, camera, RASTER, torch.full((3,), background))


def test_the_figures_of_a_run_are_those_of_its_files(trained):
    run = evaluate_run(trained)
    assert run.scene == "lab" and run.config == str(trained) and run.notes == ()
    assert run.before is not None and [view.name for view in run.after.views] == ["v00", "v08"]
    root = trained.parents[1] / "lab"
    evaluated = EvaluatedRun(trained)
    shown = evaluated.shown()  # The scene before refinement decides for both.
    del evaluated.stages["before"]
    assert not all(map(torch.equal, shown, evaluated.shown()))
    for scene, shift in ((run.before, 0.15), (run.after, 0.0)):
        surfels, ids = discs(shift=shift)
        for index, name in enumerate(("v00", "v08")):
            photo = np.asarray(Image.open(root / f"images/{name}.png")) / 255.0
            error = (rendered(trained, surfels, index).color.clamp(0, 1).numpy() - photo) ** 2
            assert scene.views[index].psnr == pytest.approx(-10 * np.log10(error.mean()), abs=1e-3)
            inside = np.asarray(Image.open(root / f"ground_truth/masks/{name}.png"))[1::2, 1::2] > 0
            inside = binary_erosion(inside, np.ones((3, 3)), border_value=1)
            assert scene.views[index].psnr_objects == pytest.approx(-10 * np.log10(error[inside].mean()), abs=1e-3)
            error = error[shown[index].numpy()]
            assert scene.views[index].psnr_shown == pytest.approx(-10 * np.log10(error.mean()), abs=1e-3)
            assert scene.views[index].shown == pytest.approx(len(error) / (WIDTH * HEIGHT)) and len(error) > 0
            silhouette = np.asarray(Image.open(root / f"ground_truth/silhouettes/cup/{name}.png")) > 0
            assert silhouette.shape == (2 * HEIGHT, 2 * WIDTH)
            alone = rendered(trained, surfels[ids == 1], index).alpha.numpy() > 0.5
            alone = alone.repeat(2, axis=0).repeat(2, axis=1)
            mask = next(m for m in scene.masks if (m.kind, m.class_id, m.view) == ("extracted", 1, index))
            assert mask.truth == "silhouette"
            assert 0 < mask.metrics.iou == (alone & silhouette).sum() / (alone | silhouette).sum()
    assert run.before.mean.extracted != run.after.mean.extracted


def test_the_files_say_everything(trained, tmp_path, capsys):
    path, picture = tmp_path / "new" / "a.json", tmp_path / "worst.png"
    files = ["--json", str(path), "--picture", str(picture), "--worst", "2"]
    main(["eval", "--load-config", str(trained), *files, "--threshold", "0.4"])
    printed = " ".join(capsys.readouterr().out.split())
    assert "else visible masks, less the pixels where another object stands nearer; above 0.4; boundary" in printed
    assert "worst: " in printed
    with Image.open(picture) as image:
        assert image.height > 2 * 258 and image.width > 6 * 240  # two lines; photo, before and after of both kinds
    scene = json.loads(path.read_text(), parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert scene["protocol"] == asdict(Protocol(threshold=0.4))
    assert set(scene) == {
        "scene", "config", "protocol", "extracted_truth", "colors_fitted", "notes", "mean", *IMAGE_FIGURES, "objects",
        "worst", "masks", "views",
    }  # fmt: skip
    assert scene["extracted_truth"] == "both" and set(scene["objects"]) == {"cup", "box"}
    figures = {"before", "after"}
    for row in (scene["mean"], *scene["objects"].values()):
        for kind in ("extracted", "rendered"):
            assert set(row[kind]) == figures
            assert all(0 <= row[kind][stage][metric] <= 1 for stage in figures for metric in ("acc", "iou", "biou"))
    assert len(scene["masks"]) == 2 * 2 * 2 and len(scene["views"]) == 2
    for mask in scene["masks"]:
        assert set(mask) == {"kind", "object", "view", "truth", "before", "after"}
    ious = [m["after"]["iou"] for m in scene["masks"] if (m["kind"], m["object"]) == ("rendered", "box")]
    assert scene["objects"]["box"]["rendered"]["after"]["iou"] == pytest.approx(np.mean(ious))
    assert scene["psnr"]["after"] == pytest.approx(np.mean([view["psnr"]["after"] for view in scene["views"]]))


def test_a_base_without_classes_has_image_figures_only(tmp_path, capsys):
    config = write_trained(tmp_path / "base", write_scene(tmp_path / "lab", masks=False), assigned=False)
    main(["eval", "--load-config", str(config), "--picture", str(tmp_path / "none.png")])
    printed = " ".join(capsys.readouterr().out.split())
    assert "PSNR, dB:" in printed and "has no classes" in printed and "No picture: no mask was scored." in printed
    assert not (tmp_path / "none.png").exists()
    run = evaluate_run(config)
    assert run.before is None and run.after.masks == () and run.after.ssim is not None


def test_notes_name_missing_masks_and_views_that_were_trained_on(tmp_path):
    config = write_trained(tmp_path / "bare", write_scene(tmp_path / "without", masks=False), base=False)
    assert evaluate_run(config).notes == ("No held-out view has a mask, so only images are scored.",)
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"), base=False)
    text = config.read_text()
    assert "eval_interval: 8" in text
    config.write_text(text.replace("eval_interval: 8", "eval_interval: 0"))
    notes = evaluate_run(config).notes
    assert len(notes) == 2 and "no saved state from before refinement" in notes[0] and "9 of these 9 views" in notes[1]


def test_notes_name_truth_of_another_scene(tmp_path, capsys):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab", truth_factor=2))
    folder = tmp_path / "lab/ground_truth/silhouettes/cup"
    for path in sorted(folder.iterdir()):
        path.rename(path.with_stem(f"other_{path.stem}"))
    main(["eval", "--load-config", str(config)])
    printed = " ".join(capsys.readouterr().out.split())
    (note,) = evaluate_run(config).notes
    assert note in printed and f"2 of the 4 files in {tmp_path}/lab/ground_truth have the name of no photo" in note
    assert "silhouettes/cup/other_v00.png among them" in note


def test_an_extracted_object_is_scored_alone(trained, tmp_path):
    whole = evaluate_run(trained)
    for removed, object_scored in ((False, 1), (True, 2)):
        (part,) = extract_objects(trained, ["cup"], removed, tmp_path / str(removed))
        run = evaluate_run(part.config)
        assert set(run.after.objects) == {object_scored} and run.before is None
        assert run.after.objects[object_scored].extracted == whole.after.objects[object_scored].extracted
        assert run.after.mean.rendered is None and run.after.psnr is None
        assert "part of a scene" in run.notes[0]


def test_truth_is_undistorted_like_the_photographs(tmp_path):
    """Discs at known rays, drawn through the lens into masks of twice the size: they must lie where the rays do."""
    rays = [(x, y) for x in (-0.4, -0.1, 0.25) for y in (-0.3, 0.2)]
    write_transforms(tmp_path / "lab", **{**LENS, **BROWN, "camera_model": "OPENCV"})
    rows, columns = (np.mgrid[: 2 * LARGE_H, : 2 * LARGE_W] + 0.5) / 2  # centres in pixels of the photograph
    ids = np.zeros(rows.shape, np.uint8)
    for number, ray in enumerate(rays, 1):
        u, v = distort("OPENCV", *ray)
        ids[(columns - u) ** 2 + (rows - v) ** 2 < 6.0**2] = number
    for index in range(9):
        write_image(tmp_path / f"lab/images/v{index:02d}.png", np.zeros((LARGE_H, LARGE_W, 3), np.uint8))
    write_image(tmp_path / "lab/ground_truth/masks/v00.png", ids)
    write_image(tmp_path / "lab/ground_truth/silhouettes/cup/v00.png", np.uint8(255) * (ids == 1))
    view = EvaluatedRun(write_trained(tmp_path / "run", tmp_path / "lab")).views[0]
    assert view.visible is not None and view.silhouettes is not None
    height, width = view.visible.shape
    assert abs(height - 2 * view.camera.height) <= 1 and abs(width - 2 * view.camera.width) <= 1
    assert torch.equal(view.silhouettes[1], view.visible == 1)
    offsets = []
    for number, (x, y) in enumerate(rays, 1):
        there = torch.nonzero(view.visible == number).double() + 0.5  # row, column
        expected = view.camera.K.double() @ torch.tensor([x, y, 1.0], dtype=torch.float64)
        scale = torch.tensor([height / view.camera.height, width / view.camera.width], dtype=torch.float64)
        offsets.append(there.mean(0) / scale - expected[:2].flip(0))
    # Offsets in pixels of the photograph: without undistortion the outer discs are off by several.
    assert torch.stack(offsets).abs().max() < 0.75 and torch.stack(offsets).mean(0).abs().max() < 0.25
    focal, center = np.array([LENS["fl_x"], LENS["fl_y"]]), np.array([LENS["cx"], LENS["cy"]])
    assert max(np.abs(distort("OPENCV", *ray) - (focal * ray + center)).max() for ray in rays) > 2


@pytest.mark.parametrize(("background", "value"), [("black", 0.0), ("white", 1.0), ("random", 0.0)])
def test_photographs_with_alpha_stand_on_the_background_of_the_training(tmp_path, background, value):
    data = write_scene(tmp_path / "lab")
    rgba = np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 4), dtype=np.uint8)
    write_image(data / "images/v00.png", rgba)
    config = write_trained(tmp_path / "run", data, background=background)
    views = EvaluatedRun(config).views
    share = rgba[..., 3:] / 255.0
    expected = share * rgba[..., :3] / 255.0 + (1 - share) * value
    assert views[0].image is not None
    np.testing.assert_allclose(views[0].image.numpy(), expected, atol=0.6 / 255)  # 8 bits
    error = np.mean((rendered(config, discs()[0], 0, value).color.clamp(0, 1).numpy() - expected) ** 2)
    assert evaluate_run(config).after.views[0].psnr == pytest.approx(-10 * np.log10(error), abs=0.02)

    options = open_for_training(config).data_config
    manager = options.setup(device="cpu", test_mode="test", world_size=1, local_rank=0)
    batch = manager.fixed_indices_eval_dataloader[0][1]
    random = torch.tensor([0.2, 0.5, 0.9])  # In training the photograph stands on the random colour.
    model = type("Model", (), {"device": "cpu", "get_gt_img": BeagsModel.get_gt_img})()
    seen = BeagsModel._truth(model, batch, random)
    wanted = share * rgba[..., :3] / 255.0 + (1 - share) * random.numpy()
    np.testing.assert_allclose(seen.numpy(), wanted, atol=0.6 / 255)
    opaque = manager.fixed_indices_eval_dataloader[1][1]
    assert "alpha" not in opaque
    assert torch.equal(BeagsModel._truth(model, opaque, random), BeagsModel.get_gt_img(model, opaque["image"]))


def test_grey_of_traced_truth_counts_nowhere(tmp_path):
    """Value 128 beside 0 and 255 alone, in silhouettes and in the masks of single objects."""
    data = write_scene(tmp_path / "lab")
    values = np.full((HEIGHT, WIDTH), 128, np.uint8)
    values[:, : WIDTH // 2], values[4:9, 4:9] = 0, 255
    for kind in ("silhouettes", "visible"):
        write_image(data / f"ground_truth/{kind}/cup/v00.png", values)
    config = write_trained(tmp_path / "run", data)
    view = EvaluatedRun(config).views[0]
    for masks, unknown in (
        (view.silhouettes, view.unknown_silhouettes),
        (view.visible_objects, view.unknown_visible),
    ):
        assert masks is not None and unknown is not None and list(masks) == list(unknown) == [1]
        assert np.array_equal(masks[1], values == 255) and np.array_equal(unknown[1], values == 128)
    alone = rendered(config, discs()[0][discs()[1] == 1], 0).alpha.numpy() > 0.5
    told = values != 128
    (mask,) = (m for m in evaluate_run(config).after.masks if m.kind == "extracted" and m.view == 0)
    assert mask.metrics.iou == (alone & (values == 255)).sum() / ((alone | (values == 255)) & told).sum() > 0
    view = EvaluatedRun(write_trained(tmp_path / "second", write_scene(tmp_path / "plain", truth_factor=2))).views[0]
    assert view.silhouettes is not None and view.unknown_silhouettes is None and view.unknown_visible is None


def test_data_that_has_gone_and_truth_of_other_proportions_are_refused(tmp_path):
    data = write_scene(tmp_path / "lab", truth_factor=2)
    write_image(data / "ground_truth/masks/v08.png", np.zeros((2 * HEIGHT, WIDTH), np.uint8))
    config = write_trained(tmp_path / "run", data)
    with pytest.raises(UserError, match=r"the mask .*v08.png is 20x24 pixels but its image is 20x12"):
        evaluate_run(config)
    data.rename(tmp_path / "moved")
    with pytest.raises(UserError, match=r"the data of .*config.yml are not at .*lab: name their place with --data"):
        evaluate_run(config)


def test_unlabelled_ids_of_the_truth_do_not_count(tmp_path):
    data = write_scene(tmp_path / "lab", truth_factor=2)
    ids = np.zeros((HEIGHT, WIDTH), np.uint8)
    ids[2:5, 3:6], ids[7:] = 1, 255
    write_image(data / "ground_truth/masks/v00.png", ids)
    config = write_trained(tmp_path / "run", data)
    config.write_text(config.read_text().replace("ignore_ids: !!python/tuple []", "ignore_ids: !!python/tuple [255]"))
    view = EvaluatedRun(config).views[0]
    assert view.visible is not None and view.silhouettes is not None
    assert (view.visible[7:] == IGNORE).all() and (view.visible[:7] == torch.from_numpy(ids[:7].astype(np.int32))).all()
    assert (view.silhouettes[1]).any()  # 255 is inside, there
