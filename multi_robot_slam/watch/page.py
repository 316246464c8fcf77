"""The page: a server on one address, the scene and the panel on it."""

import contextlib
import io
import time
from collections.abc import Callable

import numpy as np
from viser import ClientHandle, ViserServer

from multi_robot_slam.watch.address import Address
from multi_robot_slam.watch.panel import Panel
from multi_robot_slam.watch.scene import Scene
from multi_robot_slam.watch.watched import Watched

DRAW_PERIOD_S = 0.1
CHART_PERIOD_S = 1.0
FROM = np.array([0.0, -0.6, 0.8])
"""Where the camera is at first, seen from the middle of the scene, in widths of it."""


class Page:
    """Serves the page; draws when somebody looks, and then what is news only."""

    def __init__(self, address: Address, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock` is a monotonic one [s]."""
        with _silence():
            self._server = ViserServer(*address, label="multi_robot_slam", verbose=False)
        self.address = Address(address.host, self._server.get_port())
        self._clock = clock
        self._server.gui.configure_theme(
            show_logo=False, show_share_button=False, control_width="large"
        )
        self._server.gui.main_panel.dock_right()
        self.gui = self._server.gui
        self._scene = Scene(self._server)
        self._panel = Panel(self._server, self._scene, self._look)
        self._newest: Watched | None = None
        """What is watched, drawn or not."""
        self._drawn: Watched | None = None
        self._drawn_s = self._charted_s = -np.inf
        self._server.on_client_connect(self._look)

    def say(self, text: str) -> None:
        """Show one sentence while there is nothing to watch."""
        self._panel.say(text)

    def draw(self, watched: Watched) -> None:
        """Bring the page up to date, if somebody looks and it is time."""
        self._newest, now_s = watched, self._clock()
        if now_s - self._drawn_s < DRAW_PERIOD_S or not self._server.get_clients():
            return
        self._drawn_s = now_s
        with self._server.atomic():
            if self._drawn is None or watched.config is not self._drawn.config:
                self._begin(watched)
            self._drawn = watched
            self._scene.draw(watched)
            self._panel.draw(watched)
            if now_s - self._charted_s >= CHART_PERIOD_S:
                self._charted_s = now_s
                self._panel.draw_charts(watched)

    def close(self) -> None:
        """Serve no longer."""
        with _silence():
            self._server.stop()

    def _begin(self, watched: Watched) -> None:
        self._scene.clear()
        self._panel.begin(watched)
        self._charted_s = -np.inf

    def _look(self, client: ClientHandle) -> None:
        """Have a browser look at all there is so far."""
        if self._newest is not None:
            middle, width = self._newest.extent()
            # In this order: with the position moves what is looked at.
            client.camera.position = middle + width * FROM
            client.camera.look_at = middle


def _silence() -> contextlib.redirect_stdout:
    """What `viser` says on stdout when it begins and stops, whatever it is told."""
    return contextlib.redirect_stdout(io.StringIO())
