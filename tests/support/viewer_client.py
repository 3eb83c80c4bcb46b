"""Somebody who watches in nerfstudio's viewer, as its server sees it: a client of its websocket, without a browser."""

from __future__ import annotations

import math
import threading
import time
from contextlib import suppress
from io import BytesIO

import msgspec
import numpy as np
from data_folders import look_at
from PIL import Image
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect


class ViewerClient(threading.Thread):
    """Connects as soon as a viewer listens on ``port``, then moves around the scene and looks at one output after the
    other, until it is closed.

    pictures: how many came while nerfstudio showed each step. seen: the outputs that were looked at, each with the last
    picture, [H, W, 3] uint8.
    """

    def __init__(self, port: int, outputs: list[str], distance: float, pause: float = 0.2) -> None:
        super().__init__(daemon=True)
        self.port, self.outputs, self.distance, self.pause = port, outputs, distance, pause
        self.pictures: dict[int, int] = {}
        self.seen: dict[str, np.ndarray] = {}
        self.errors: list[BaseException] = []
        self._step = 0
        self._output = "rgb"
        self._ids: dict[str, str] = {}
        self._came = threading.Event()

    def run(self) -> None:
        try:
            self._socket = self._connected()
            threading.Thread(target=self._walk, daemon=True).start()
            with suppress(ConnectionClosed):
                while True:
                    for message in _messages(self._socket.recv()):
                        self._take(message)
        except BaseException as error:
            self.errors.append(error)

    def close(self) -> None:
        """Leave; nerfstudio's server would hold the connection as long as the process lives."""
        self._socket.close()
        self.join(30)

    def wait_for_a_picture(self, seconds: float = 120.0) -> bool:
        """Return whether a picture comes after this call."""
        self._came.clear()
        return self._came.wait(seconds)

    def _connected(self):
        end = time.monotonic() + 120
        while True:
            try:
                return connect(f"ws://127.0.0.1:{self.port}", max_size=None, compression=None)
            except OSError:
                assert time.monotonic() < end
                time.sleep(0.05)

    def _take(self, message: dict) -> None:
        if message["type"] == "GuiAddDropdownMessage":
            self._ids[message["label"]] = message["id"]
        elif message["type"] == "GuiUpdateMessage":
            for value in message["updates"].values():
                if str(value).startswith("Step: "):
                    self._step = int(value.split()[1])
        elif message["type"] == "BackgroundImageMessage":
            self.pictures[self._step] = self.pictures.get(self._step, 0) + 1
            self.seen[self._output] = np.asarray(Image.open(BytesIO(message["rgb_bytes"])))
            self._came.set()

    def _walk(self) -> None:
        turn = 0
        with suppress(ConnectionClosed):
            while True:
                self._look(0.4 * turn)
                if self.seen and "Output type" in self._ids and turn % 3 == 2:  # first a picture of colours
                    self._output = self.outputs[turn // 3 % len(self.outputs)]
                    self._send("GuiUpdateMessage", id=self._ids["Output type"], updates={"value": self._output})
                turn += 1
                time.sleep(self.pause)

    def _look(self, angle: float) -> None:
        """Look at the origin from the circle; viser's world is ten times as large as nerfstudio's."""
        from viser.transforms import SO3

        place = 10 * self.distance * np.array([math.cos(angle), math.sin(angle), 0.3])
        rotation = look_at(place)[:3, :3] @ np.diag([1.0, -1.0, -1.0])
        self._send(
            "ViewerCameraMessage",
            wxyz=SO3.from_matrix(rotation).wxyz.tolist(), position=place.tolist(), fov=1.0, aspect=1.4,
            look_at=[0.0, 0.0, 0.0], up_direction=[0.0, 0.0, 1.0],
        )  # fmt: skip

    def _send(self, kind: str, **content) -> None:
        self._socket.send(msgspec.msgpack.encode({"type": kind, **content}))


def _messages(raw: bytes) -> list[dict]:
    found = msgspec.msgpack.decode(raw)
    return found if isinstance(found, list) else [found]
