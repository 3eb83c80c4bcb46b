"""Photos on disk."""

from __future__ import annotations

import pytest
from data_folders import noise, write_image

from beags_plugin.data.files import image_size
from beags_plugin.system.errors import UserError


@pytest.mark.parametrize("name", ["photo.png", "photo.jpg"])
def test_an_image_that_is_cut_off_is_refused_where_its_size_is_read(tmp_path, name):
    write_image(path := tmp_path / name, noise(0, 120, 80))
    content, size = path.read_bytes(), image_size(path)
    path.write_bytes(content + bytes(50))  # a film behind the picture, as phones write
    assert image_size(path) == size
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(UserError, match=f"{name} cannot be read as an image .*truncated.*: replace it"):
        image_size(path)
