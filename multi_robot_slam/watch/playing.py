"""Plays a run that is over: slider, speed, pause."""

import time
from collections.abc import Callable
from typing import Any

from multi_robot_slam.bags.playback import Pace
from multi_robot_slam.watch.page import DRAW_PERIOD_S, Page
from multi_robot_slam.watch.recording import Recording

SPEEDS = ("0.2", "0.5", "1", "2", "5", "10", "50")


class Player:
    """Has the page show a recording, from its beginning on, as its controls say."""

    def __init__(
        self, page: Page, recording: Recording, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """`clock` is a monotonic one [s]."""
        self._page, self._recording, self._clock = page, recording, clock
        length_s = round(max(self._seconds(recording.end_ns), 0.1), 1)
        with page.gui.add_folder("Time", order=0):
            self.slider: Any = page.gui.add_slider("seconds", 0.0, length_s, 0.1, 0.0)
            self.speed = page.gui.add_dropdown(
                "speed", SPEEDS, initial_value="1", hint="times the recording's"
            )
            self.pause = page.gui.add_checkbox("pause", False)
        self._shown_s, self._rate = 0.0, 1.0
        self._pace = Pace(self._rate, clock)
        self._pace.start(recording.begin_ns)

    def work(self) -> float:
        """Show what is due; the seconds until there is more to do."""
        self._obey()
        now_ns = min(self._pace.now_ns(), self._recording.end_ns)
        self._shown_s = round(self._seconds(now_ns), 1)
        if self.slider.value != self._shown_s:
            self.slider.value = self._shown_s
        self._page.draw(self._recording.at(now_ns))
        return DRAW_PERIOD_S

    def _obey(self) -> None:
        """Do what was asked for with the controls."""
        now_ns, rate = min(self._pace.now_ns(), self._recording.end_ns), float(self.speed.value)
        moved = self.slider.value
        if moved != self._shown_s:
            now_ns = self._recording.begin_ns + round(moved * 1e9)
        if moved != self._shown_s or rate != self._rate:
            self._rate, self._pace = rate, Pace(rate, self._clock)
            self._pace.start(now_ns)
        self._pace.pause() if self.pause.value else self._pace.resume()

    def _seconds(self, stamp_ns: int) -> float:
        return (stamp_ns - self._recording.begin_ns) / 1e9
