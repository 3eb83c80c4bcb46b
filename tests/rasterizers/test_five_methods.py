"""A backend that writes no more than it must."""

from __future__ import annotations

import pytest
from raster_scenes import CLASSES, make_scene

from beags_plugin.rasterizers import RASTERIZERS, DeviceDispatchRasterizer
from beags_plugin.rasterizers.interface import Rasterizer
from beags_plugin.rasterizers.optional import OptionalProducts, optional_products
from beags_plugin.rasterizers.torch_reference import TorchRasterizer
from beags_plugin.system.errors import UserError

WRITTEN = ("unavailable", "rasterize", "class_contributions", "class_map", "dominant_gaussian")


@pytest.fixture
def backend():
    """The reference's five methods under another name; all else is the interface's."""
    own = {name: value for name, value in TorchRasterizer.__dict__.items() if name in WRITTEN or name == "__init__"}
    helpers = {name: value for name, value in TorchRasterizer.__dict__.items() if name[0] == "_" != name[1]}
    return type("Five", (Rasterizer,), {**helpers, **own})()


def test_a_backend_writes_five_methods_and_has_the_products_of_assignment(backend):
    assert Rasterizer.__abstractmethods__ == set(WRITTEN)
    scene = make_scene()
    what = (scene.inputs, scene.camera, scene.settings, scene.target, CLASSES)
    keys, values = backend.sparse_class_contributions(*what)
    table = backend.class_contributions(*what)
    assert len(keys) > 0 and (table.view(-1)[keys] == values).all() and values.sum() == pytest.approx(table.sum())


def test_what_it_lacks_is_said_where_a_refiner_asks_for_it(backend):
    sentence = "the rasterizer Five lacks products that this refiner needs: train with --pipeline.model.rasterizer nat"
    with pytest.raises(UserError, match=sentence):
        optional_products(backend)
    with pytest.raises(UserError, match=sentence):
        DeviceDispatchRasterizer(backend, backend).class_channels(make_scene().inputs)
    assert all(issubclass(RASTERIZERS.get(name), OptionalProducts) for name in ("cuda", "native", "torch"))
