"""glTF with KHR_gaussian_splatting: by hand, and read by ourselves, Khronos' validator and three.js."""

from __future__ import annotations

import functools
import http.server
import json
import math
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("open3d")
pytest.importorskip("trimesh")

from browser import NEEDED as IN_A_BROWSER
from browser import Page
from disc_meshes import discs_on
from other_programs import READ_BY_PLAYCANVAS, by_node, converted, node_package
from random_surfels import random_surfels
from run_folders import discs
from test_closing import a_box, item_of
from test_gltf_validator import VALIDATED, report
from written_splats import differences, write

from beags_plugin.core.flattening import flatten
from beags_plugin.core.sh import sh_colors
from beags_plugin.core.surfels import Surfels
from beags_plugin.export.base import make_exporter
from beags_plugin.importers.base import read_scene
from beags_plugin.splat_io.ply import THICKNESS
from beags_plugin.surfaces.closing_gaussians import with_closing
from beags_plugin.surfaces.item import ExportItem, NothingToExport
from beags_plugin.surfaces.mesh_options import MeshOptions
from beags_plugin.system.errors import UserError

NAMES = {0: "background", 1: "a naïve cup", 2: "box"}
PREFIX = "KHR_gaussian_splatting"


def write_scene(path: Path) -> tuple[Surfels, torch.Tensor]:
    surfels, ids = discs()
    facts = make_exporter("gltf-splats").write(path, ExportItem("whole scene", surfels, ids, class_names=NAMES))
    assert facts == {"nodes": 3}
    return surfels, ids


def content_of(path: Path) -> tuple[dict[str, Any], bytes]:
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[20 + length + 8 :]


def values(content: dict[str, Any], binary: bytes, number: int) -> np.ndarray:
    """An accessor, read by hand."""
    accessor = content["accessors"][number]
    view = content["bufferViews"][accessor["bufferView"]]
    dtype = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    found = np.frombuffer(binary, dtype, accessor["count"] * width, view["byteOffset"])
    return found.reshape(accessor["count"], width)


def written_as(path: Path, kind: str) -> Path:
    """Write a scene of "splats", or a closed box of "both"; returns the path."""
    if kind == "splats":
        write_scene(path)
    else:
        make_exporter("gltf-both", resolution=48, texture="none").write(path, a_closed_item())
    return path


def changed(path: Path, change) -> Path:
    """Write a .glb with another JSON, which ``change`` returns or changes."""
    content, binary = content_of(path)
    text = json.dumps(change(content) or content).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    return path


def test_without_scenes_each_node_is_taken_once_where_its_parents_put_it(tmp_path):
    surfels, _ = write_scene(tmp_path / "a.glb")
    whole = read_scene(tmp_path / "a.glb").gaussians.means

    def below_one(content):
        del content["scenes"], content["scene"]
        content["nodes"].append({"children": list(range(len(content["nodes"]))), "scale": [2.0, 2.0, 2.0]})

    found = read_scene(changed(tmp_path / "a.glb", below_one)).gaussians.means
    assert len(found) == len(surfels) and torch.allclose(found, 2.0 * whole, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda content: [content], "is no .glb of splats"),
        (lambda content: {**content, "asset": "none"}, "is no .glb of splats"),
        (lambda content: content["nodes"][0].update(children=[0]), "or below itself"),
        (lambda content: content["scenes"][0]["nodes"].extend([0, 0]), "is below two others"),
        (lambda content: [view.update(byteStride=0) for view in content["bufferViews"]] and None, "does not fit"),
        (lambda content: content["accessors"][0].update(count=1), "not as many places|does not fit"),
    ],
)
def test_a_damaged_tree_is_refused_in_one_sentence(tmp_path, change, words):
    write_scene(tmp_path / "a.glb")
    with pytest.raises(UserError, match=words):
        read_scene(changed(tmp_path / "a.glb", change))


def test_there_is_a_node_for_each_object_with_its_name(tmp_path):
    surfels, ids = write_scene(tmp_path / "scene.glb")
    content, _ = content_of(tmp_path / "scene.glb")
    assert content["scenes"] == [{"nodes": [0, 1, 2]}] and content["extensionsUsed"] == [PREFIX]
    assert [node["name"] for node in content["nodes"]] == list(NAMES.values())
    assert [node["extras"] for node in content["nodes"]] == [{"class_id": each} for each in NAMES]
    for mesh in content["meshes"]:
        (primitive,) = mesh["primitives"]
        assert primitive["mode"] == 0
        assert primitive["extensions"] == {PREFIX: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    found = read_scene(tmp_path / "scene.glb")
    assert found.kind == "glTF of splats" and found.remarks == ()
    order = torch.argsort(ids, stable=True)
    assert max(differences(flatten(found.gaussians)[0], surfels[order]).values()) < 1e-4


def test_a_known_gaussian_has_known_values(tmp_path):
    """Lengths and shares, as the ratified extension has them; z becomes y, and y becomes -z."""
    surfel = Surfels(
        torch.tensor([[1.0, 2.0, 3.0]]),
        torch.tensor([[2.0, 0.0, 0.0, 0.0]]),
        torch.tensor([[-2.0, -1.0]]),
        torch.tensor([0.0]),
        torch.tensor([[0.0, 1.0, -9.0]]),
        torch.tensor([[[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9]]]),
    )
    path = write(tmp_path / "one.glb", "gltf-splats", surfel)
    content, binary = content_of(path)
    attributes = content["meshes"][0]["primitives"][0]["attributes"]
    found = {name: values(content, binary, number)[0] for name, number in attributes.items()}
    assert content["nodes"][0]["name"] == "cup"
    assert found["POSITION"].tolist() == [1.0, 3.0, -2.0]
    assert found[f"{PREFIX}:SCALE"] == pytest.approx([math.exp(-2), math.exp(-1), THICKNESS * math.exp(-2)], rel=1e-5)
    assert found[f"{PREFIX}:OPACITY"] == pytest.approx(0.5)
    s = math.sqrt(0.5)  # a quarter turn back about x
    assert found[f"{PREFIX}:ROTATION"] == pytest.approx([-s, 0, 0, s], abs=1e-6)
    assert found[f"{PREFIX}:SH_DEGREE_0_COEF_0"].tolist() == [0.0, 1.0, -9.0]
    # Band 1 has the functions -y, z and -x; our z is the file's y, and our y its -z.
    assert found[f"{PREFIX}:SH_DEGREE_1_COEF_0"] == pytest.approx([-0.4, -0.5, -0.6], abs=1e-6)
    assert found[f"{PREFIX}:SH_DEGREE_1_COEF_1"] == pytest.approx([0.1, 0.2, 0.3], abs=1e-6)
    assert found[f"{PREFIX}:SH_DEGREE_1_COEF_2"] == pytest.approx([0.7, 0.8, 0.9], abs=1e-6)
    assert found["COLOR_0"].tolist() == [128, round(255 * (0.5 + 0.28209479)), 0, 128]


def test_colours_look_the_same_from_every_side(tmp_path):
    surfels = random_surfels(count=30)
    content, binary = content_of(write(tmp_path / "cup.glb", "gltf-splats", surfels))
    attributes = content["meshes"][0]["primitives"][0]["attributes"]
    names = [f"{PREFIX}:SH_DEGREE_{d}_COEF_{i}" for d in range(1, 4) for i in range(2 * d + 1)]
    rest = torch.from_numpy(np.stack([values(content, binary, attributes[name]) for name in names], axis=1))
    means = torch.from_numpy(values(content, binary, attributes["POSITION"]).copy())
    eye = torch.tensor([2.0, -3.0, 1.0])
    before = sh_colors(surfels.sh_dc, surfels.sh_rest, surfels.means, eye, 3)
    assert torch.allclose(sh_colors(surfels.sh_dc, rest, means, eye[[0, 2, 1]] * torch.tensor([1, 1, -1]), 3), before,
                          atol=1e-5)  # fmt: skip


def a_closed_item() -> ExportItem:
    """Discs on a box that no view shows from below, with Gaussians that close it."""
    item, added = with_closing(item_of(discs_on(a_box(bottom=False))), MeshOptions(resolution=48))
    assert added.gaussians > 0
    return item


def test_splats_and_mesh_in_one_file(tmp_path):
    item = a_closed_item()
    facts = make_exporter("gltf-both", resolution=48, texture="none").write(tmp_path / "box.glb", item)
    content, binary = content_of(tmp_path / "box.glb")
    (root,) = content["scenes"][0]["nodes"]
    assert content["nodes"][root]["name"] == "box"
    below = [content["nodes"][child] for child in content["nodes"][root]["children"]]
    assert [node["name"] for node in below] == ["box splats", "box mesh"]
    splats, mesh = (content["meshes"][node["mesh"]]["primitives"][0] for node in below)
    assert content["accessors"][splats["attributes"]["POSITION"]]["count"] == len(item.surfels)
    assert values(content, binary, splats["attributes"]["_INVENTED"]).sum() == item.invented.sum()
    assert content["accessors"][mesh["indices"]]["count"] == 3 * facts["triangles"] and facts["closed_share"] > 0.05
    low, high = (np.array([content["accessors"][each["attributes"]["POSITION"]][end] for each in (splats, mesh)])
                 for end in ("min", "max"))  # fmt: skip
    assert np.abs(low[0] - low[1]).max() < 0.1 and np.abs(high[0] - high[1]).max() < 0.1
    assert len(read_scene(tmp_path / "box.glb").gaussians) == len(item.surfels)


def test_a_scene_whose_nodes_move_it_is_read_where_they_put_it(tmp_path):
    surfels, _ = write_scene(tmp_path / "scene.glb")
    content, binary = content_of(tmp_path / "scene.glb")
    (tmp_path / "data.bin").write_bytes(binary)
    content["buffers"][0]["uri"] = "data.bin"
    s = math.sqrt(0.5)
    content["nodes"].append(
        {"children": [0, 1, 2], "translation": [0, 5, 0], "rotation": [0, s, 0, s], "scale": [2] * 3}
    )
    content["scenes"] = [{"nodes": [3]}]
    (tmp_path / "moved.gltf").write_text(json.dumps(content))
    found, plain = (read_scene(tmp_path / name).gaussians for name in ("moved.gltf", "scene.glb"))
    x, y, z = plain.means.unbind(1)  # The file's y is our z.
    assert torch.allclose(found.means, torch.stack([-2 * y, 2 * x, 2 * z + 5], dim=1), atol=1e-5)
    assert torch.allclose(found.log_scales, plain.log_scales + math.log(2), atol=1e-5)
    content["nodes"][3]["scale"] = [1, 2, 1]
    (tmp_path / "moved.gltf").write_text(json.dumps(content))
    with pytest.raises(UserError, match="stretches or mirrors"):
        read_scene(tmp_path / "moved.gltf")
    content["buffers"][0]["uri"] = "../data.bin"
    (tmp_path / "moved.gltf").write_text(json.dumps(content))
    with pytest.raises(UserError, match="names the file"):
        read_scene(tmp_path / "moved.gltf")


def test_what_cannot_be_read_or_written(tmp_path):
    path = write(tmp_path / "cup.glb", "gltf-splats", random_surfels())
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(UserError, match="ends within a chunk"):
        read_scene(path)
    path.write_bytes(b"glTF nothing of the kind")
    with pytest.raises(UserError, match=r"is no .glb of splats file, or damaged"):
        read_scene(path)
    with pytest.raises(NothingToExport, match="no finite Gaussian"):
        write(tmp_path / "none.glb", "gltf-splats", random_surfels()[:0])


@VALIDATED
@pytest.mark.parametrize("kind", ["splats", "both"])
def test_the_validator_finds_nothing_but_that_it_does_not_know_the_extension(tmp_path, kind):
    """2.0.0-dev.3.10 is older than the extension. With the extension's names hidden from it, it finds nothing."""
    path = written_as(tmp_path / "scene.glb", kind)
    content, binary = content_of(path)
    unknown = {("UNSUPPORTED_EXTENSION", "/extensionsUsed/0")}
    for mesh, entry in enumerate(content["meshes"]):
        for name in entry["primitives"][0]["attributes"]:
            if ":" in name:
                pointer = f"/meshes/{mesh}/primitives/0/attributes/{name}"
                unknown.add(("MESH_PRIMITIVE_INVALID_ATTRIBUTE", pointer))
    found = {(issue["code"], issue["pointer"]) for issue in report(path)["issues"]["messages"]}
    assert found <= unknown
    text = json.dumps(content).replace(f"{PREFIX}:", "_").replace(f'"{PREFIX}", ', "").replace(f'["{PREFIX}"]', "[]")
    bare = json.loads(text)
    for entry in bare["meshes"]:
        entry["primitives"][0].pop("extensions", None)
    if not bare["extensionsUsed"]:
        del bare["extensionsUsed"]
    head = json.dumps(bare).encode()
    head += b" " * (-len(head) % 4)
    size = struct.pack("<4sII", b"glTF", 2, 28 + len(head) + len(binary)) + struct.pack("<I4s", len(head), b"JSON")
    (tmp_path / "bare.glb").write_bytes(size + head + struct.pack("<I4s", len(binary), b"BIN\0") + binary)
    assert report(tmp_path / "bare.glb")["issues"]["messages"] == []


@READ_BY_PLAYCANVAS
def test_what_playcanvas_writes_is_read_the_same(tmp_path):
    surfels = random_surfels(count=300)
    path = converted(write(tmp_path / "cup.ply", "ply", surfels), tmp_path / "theirs.glb")
    assert max(differences(flatten(read_scene(path).gaussians)[0], surfels).values()) < 1e-4


# -- three.js ----------------------------------------------------------------------------------------------------------

LOADER = "examples/jsm/loaders/GLTFGaussianSplatLoaderExtension.js"


def three() -> Path | None:
    """three.js with its loader of the extension: the folder of THREE_JS, or installed by npm for all."""
    found = node_package("three", "THREE_JS")
    return found if found is not None and (found / LOADER).is_file() else None


READ_BY_THREE = pytest.mark.skipif(
    three() is None,
    reason="there is no three.js that knows KHR_gaussian_splatting, so it reads no .glb of splats "
    "(npm install -g three, or name its folder in THREE_JS)",
)
_LOADED = """
    loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
    const found = [];
    const gltf = await loader.parseAsync(data, "");
    gltf.scene.updateMatrixWorld();
    gltf.scene.traverse((one) => {
        if (one.constructor.name != "GaussianSplat" && !one.isMesh) return;
        const box = one.geometry.boundingBox ?? (one.geometry.computeBoundingBox(), one.geometry.boundingBox);
        found.push([one.userData.name ?? one.name, one.constructor.name, box.min.toArray(), box.max.toArray()]);
    });
"""


@READ_BY_THREE
@pytest.mark.parametrize("kind", ["splats", "both"])
def test_the_loader_of_three_js_reads_it(tmp_path, kind):
    path = written_as(tmp_path / "scene.glb", kind)
    program = (
        """
        const fs = await import("fs");
        const { pathToFileURL } = await import("url");
        const [folder, path] = process.argv.slice(1);
        globalThis.self = globalThis;
        const at = (name) => import(pathToFileURL(folder + "/examples/jsm/loaders/" + name));
        const { GLTFLoader } = await at("GLTFLoader.js");
        const { GLTFGaussianSplatLoaderExtension } = await at("GLTFGaussianSplatLoaderExtension.js");
        const file = fs.readFileSync(path);
        const data = file.buffer.slice(file.byteOffset, file.byteOffset + file.byteLength);
        const loader = new GLTFLoader();
        """
        + _LOADED
        + "console.log(JSON.stringify(found));"
    )
    found = by_node(program, str(three()), path)
    if kind == "splats":
        assert [(name, class_name) for name, class_name, *_ in found] == [
            (name, "GaussianSplat") for name in NAMES.values()
        ]
    else:
        assert [class_name for _, class_name, *_ in found] == ["GaussianSplat", "Mesh"]


@contextmanager
def served(*folders: tuple[str, Path]) -> Iterator[str]:
    """The address of a server of folders by their first words."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def translate_path(self, path: str) -> str:
            word, _, rest = path.partition("?")[0].lstrip("/").partition("/")
            return str(dict(folders)[word] / rest)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()


@READ_BY_THREE
@IN_A_BROWSER
def test_three_js_draws_it_in_a_browser(tmp_path):
    """The cup and the box lie left and right of the middle, above the background."""
    write_scene(tmp_path / "scene.glb")
    imports = {"three": "/three/build/three.webgpu.js", "three/webgpu": "/three/build/three.webgpu.js"}
    imports |= {"three/tsl": "/three/build/three.tsl.js", "three/addons/": "/three/examples/jsm/"}
    page = f"""<!doctype html><body style="margin:0">
    <script type="importmap">{json.dumps({"imports": imports})}</script>
    <script type="module">
        import * as THREE from "three/webgpu";
        import {{ GLTFLoader }} from "three/addons/loaders/GLTFLoader.js";
        import {{ GLTFGaussianSplatLoaderExtension }} from "three/addons/loaders/GLTFGaussianSplatLoaderExtension.js";
        window.onunhandledrejection = (event) => {{ window.failed = String(event.reason); }};
        const data = await (await fetch("/files/scene.glb")).arrayBuffer();
        const loader = new GLTFLoader();
        {_LOADED}
        const renderer = new THREE.WebGPURenderer({{ forceWebGL: true }});
        renderer.setSize(320, 240);
        document.body.append(renderer.domElement);
        await renderer.init();
        const camera = new THREE.PerspectiveCamera(50, 320 / 240, 0.1, 50);
        camera.position.set(0, 0, 3);
        const scene = new THREE.Scene();
        scene.add(gltf.scene);
        await renderer.renderAsync(scene, camera);
        await renderer.renderAsync(scene, camera);
        const picture = new OffscreenCanvas(320, 240).getContext("2d");
        picture.drawImage(renderer.domElement, 0, 0);
        const pixels = picture.getImageData(0, 0, 320, 240).data;
        const lit = [];
        for (let at = 0; at < pixels.length; at += 4)
            if (pixels[at] + pixels[at + 1] + pixels[at + 2] > 60) lit.push([(at / 4) % 320, Math.floor(at / 1280)]);
        window.done = {{ found, lit }};
    </script>"""
    (tmp_path / "page.html").write_text(page)
    folder = three()
    assert folder is not None
    with (
        served(("files", tmp_path), ("three", folder)) as address,
        Page(f"{address}/files/page.html", 400, 300) as opened,
    ):
        opened.wait(lambda: opened.evaluate("Boolean(window.done || window.failed)"))
        assert opened.evaluate("window.failed ?? ''") == ""
        done = opened.evaluate("window.done")
    assert [name for name, *_ in done["found"]] == list(NAMES.values())
    x, y = np.array(done["lit"]).T
    assert len(x) > 2000
    above = y < 130
    assert (above & (x < 150)).sum() > 300 and (above & (x > 170)).sum() > 300
    assert (~above & (np.abs(x - 160) < 40)).sum() > 100
