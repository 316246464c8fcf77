"""The page in a real browser: robots move, numbers change, and it asks for nothing elsewhere."""

import io
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from browsing import chromium, is_browsers_own, proxy, requested, said
from matplotlib.image import imread
from patience import PATIENCE_S

from msg_defs.types import Image
from multi_robot_slam.watch import address
from multi_robot_slam.watch.address import Serving
from multi_robot_slam.watch.page import FROM, Page
from multi_robot_slam.watch.playing import Player
from multi_robot_slam.watch.recording import Recording
from multi_robot_slam.watch.scene import LAYERS, colour_of
from test.helpers import fake_run
from test.watch import published


def run():
    """Of two robots, whose matches are better and better."""
    made = fake_run(robots=2, steps=20, landmarks=8)
    for step in made.steps:
        for place, frame in enumerate(step.frames):
            frame.mahalanobis[:] = 5 + place - step.step / 10
    return made


RUN = run()
NOT_THE_ROBOTS = [layer for layer in LAYERS if layer != "robots"]
NOTICE_PX = 160
"""At the top, where the page may say that it draws in software."""


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """A browser that looks at `RUN`, paused at its beginning; the page, the player, a twin."""
    folder = tmp_path_factory.mktemp("watched")
    published.record(folder / "bag", RUN)
    page = Page(address.free(Serving(port=18380)))
    player = Player(page, Recording(folder / "bag"))
    player.pause.value = True
    is_over = threading.Event()

    def play():
        while not is_over.wait(player.work()):
            pass

    thread = threading.Thread(target=play)
    thread.start()
    twin = Recording(folder / "bag")
    try:
        with proxy() as (port, elsewhere), chromium(folder / "profile", 1000, 700, port) as browser:
            browser.get(str(page.address))
            until(lambda: figure(browser, "steps"))
            yield SimpleNamespace(
                browser=browser, page=page, player=player, twin=twin, elsewhere=elsewhere
            )
    finally:
        is_over.set()
        thread.join()
        page.close()


def until(condition):
    """What `condition` gives as soon as it gives something."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not (found := condition()):
        assert time.monotonic() < deadline_s, "waited in vain"
        time.sleep(0.1)
    return found


def figure(browser, name):
    """A number of the panel as text; None while it is not there."""
    return browser.execute_script(
        "return document.querySelector(`[data-figure='${arguments[0]}']`)?.textContent", name
    )


def row(browser, robot):
    """The cells of a robot's row."""
    return browser.execute_script(
        "return [...document.querySelector(`[data-robot='${arguments[0]}']`).cells]"
        ".map(cell => cell.textContent.trim())",
        robot,
    )


def go_to(shown, seconds):
    """Put the slider at a time, and wait for the numbers of that time."""
    shown.player.slider.value = seconds
    until(lambda: figure(shown.browser, "time") == f"{seconds:.1f} s")
    return shown.twin.at(shown.twin.begin_ns + round(seconds * 1e9))


def show(shown, layers, is_shown):
    for layer in layers:
        shown.page._scene.show(layer, is_shown)


def drawn_px(browser, place):
    """Middle (2,) of what has the colour of the robot at this place in the team, once it is still.

    Column and row in the window [px].
    """
    before = None
    while True:
        picture = imread(io.BytesIO(browser.get_screenshot_as_png()), format="png")[..., :3]
        left, top, width, height = map(int, scene_px(browser))
        scene = picture[max(top, NOTICE_PX) : top + height, left : left + width]
        away = np.abs(scene - np.array(colour_of(place)) / 255).sum(axis=2)
        found = np.argwhere(away < 0.2)[:, ::-1] + [left, max(top, NOTICE_PX)]
        if len(found) and np.array_equal(found, before):
            return found.mean(axis=0)
        before = found


def scene_px(browser):
    """Left, top, width and height of the scene in the window [px]."""
    return browser.execute_script(
        "const {x, y, width, height} = document.querySelector('canvas').getBoundingClientRect();"
        "return [x, y, width, height]"
    )


def expected_px(shown, middle, width_m, place_m):
    """Where a place (3,) of the map is in the window, as a browser looks at first [px]."""
    eye = middle + width_m * FROM
    forward = (middle - eye) / np.linalg.norm(middle - eye)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    x, y, z = np.array([right, np.cross(right, forward), forward]) @ (place_m - eye)
    left, top, width_px, height_px = scene_px(shown.browser)
    focal_px = height_px / 2 / np.tan(np.radians(75) / 2)
    return left + width_px / 2 + focal_px * x / z, top + height_px / 2 - focal_px * y / z


def test_robots_are_drawn_where_they_are(shown):
    view = shown.twin.at(shown.twin.begin_ns).extent()
    show(shown, NOT_THE_ROBOTS, False)
    try:
        for seconds in (0.0, 1.0, 1.9, 0.5):
            known = go_to(shown, seconds)
            for place, robot in enumerate(known.robots.values()):
                # Most of what is drawn is where its camera looks.
                x, y, yaw = robot.estimate.pose
                ahead = np.array([x + 0.5 * np.cos(yaw), y + 0.5 * np.sin(yaw), 0.8])
                off = drawn_px(shown.browser, place) - expected_px(shown, *view, ahead)
                assert np.hypot(*off) < 25
    finally:
        show(shown, NOT_THE_ROBOTS, True)


def test_numbers_are_those_of_the_time(shown):
    for seconds in (1.9, 0.0, 1.2):
        known = go_to(shown, seconds)
        assert figure(shown.browser, "steps") == str(known.steps[-1].step)
        assert figure(shown.browser, "landmarks") == str(len(known.landmarks.ids))
        assert figure(shown.browser, "dropped") == "2 late"
        frame = known.robots["robot_2"].frame
        name, state, matched, new, *_ = row(shown.browser, "robot_2")
        assert (name.split()[-1], state.split()[-1]) == ("robot_2", "heard")
        assert (matched, new) == (str((~frame.is_new).sum()), str(frame.is_new.sum()))


def test_every_chart_has_a_curve(shown):
    go_to(shown, 1.9)
    until(lambda: len(curves := coloured_px(shown.browser)) == 4 and min(curves) > 50)


def coloured_px(browser):
    """Pixels that are not grey in each chart."""
    return browser.execute_script("""
        return [...document.querySelectorAll(".uplot canvas")].map(canvas => {
            const {data} = canvas.getContext("2d")
                .getImageData(0, 0, canvas.width, canvas.height);
            let count = 0;
            for (let i = 0; i < data.length; i += 4)
                count += data[i + 3] > 100 && data[i + 2] - data[i] > 60;
            return count;
        });
    """)


def test_a_picture_appears_beside_the_scene(shown):
    known = go_to(shown, 1.0)
    watched = shown.player._recording.at(shown.twin.begin_ns + 10**9)
    pixels = np.full((30, 40), 128, np.uint8)
    assert not pictures(shown.browser)
    watched.take_picture("robot_1", Image(1, "", "mono8", pixels))
    until(lambda: pictures(shown.browser))
    assert known is not watched


def pictures(browser):
    """Sizes of the pictures in the panel [px]."""
    return browser.execute_script(
        "return [...document.querySelectorAll('img')].filter(i => i.naturalWidth === 40)"
        ".map(i => i.naturalHeight)"
    )


def test_nothing_is_complained_of_and_nothing_is_asked_for_elsewhere(shown):
    complaints = [text for level, text in said(shown.browser) if level in ("WARNING", "SEVERE")]
    assert [text for text in complaints if not is_harmless(text)] == []
    asked = {url for url in requested(shown.browser) if url.startswith(("http", "ws"))}
    assert asked == {f"{shown.page.address}/"}
    assert [line for line in shown.elsewhere if not is_browsers_own(line)] == []


def is_harmless(text):
    """What the browser says of drawing in software, and of what viser is made of."""
    return any(k in text for k in ("GL Driver", "THREE.Clock", "WebGL", "willReadFrequently"))
