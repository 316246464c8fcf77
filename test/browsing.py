"""A real browser for tests, which notes what it is told and what it asks the network for."""

import json
import re
import shutil
import socket
import threading
from contextlib import contextmanager, suppress

import pytest

FLAGS = (
    *("--headless", "--no-sandbox", "--no-first-run", "--disable-quic", "--hide-scrollbars"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
"""As the browser is started; without a graphics card it draws three dimensions in software."""


BROWSERS_OWN = re.compile(
    r"\w+ (http://)?(accounts|clients2|android\.clients|update|www)\.google\.com[:/]"
    r"|\w+ (http://)?(content-autofill|optimizationguide-pa|safebrowsing)\.googleapis\.com[:/]"
)
"""What Chromium asks for by itself, whatever page is open."""


@contextmanager
def proxy():
    """A port to which a browser turns for whatever is not on this machine, and what it asked for.

    It gets no answer. What the workers of a page ask for is in no other log.
    """
    asked, is_over = [], threading.Event()

    def answer(server):
        while not is_over.is_set():
            with suppress(OSError), server.accept()[0] as connection:
                asked.append(connection.recv(200).partition(b"\r\n")[0].decode(errors="replace"))

    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.2)
        thread = threading.Thread(target=answer, args=(server,))
        thread.start()
        try:
            yield server.getsockname()[1], asked
        finally:
            is_over.set()
            thread.join()


@contextmanager
def chromium(profile, width_px, height_px, proxy_port=None):
    """A window of Chromium with its profile in a folder; skips the test where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver")
    program = shutil.which("chromium") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip("no Chromium: install the packages chromium and chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    through = () if proxy_port is None else (f"--proxy-server=127.0.0.1:{proxy_port}",)
    for flag in (*FLAGS, f"--user-data-dir={profile}", *through):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    service = webdriver.ChromeService(executable_path=driver)
    with webdriver.Chrome(options=options, service=service) as browser:
        browser.set_window_size(width_px, height_px)
        browser.set_page_load_timeout(60)
        browser.set_script_timeout(60)
        said(browser), requested(browser)
        yield browser


def is_browsers_own(line):
    """The browser asked for it, not the page."""
    return BROWSERS_OWN.match(line) is not None


def said(browser):
    """(level, text) of everything on the console since it was asked last."""
    return [(entry["level"], entry["message"]) for entry in browser.get_log("browser")]


def requested(browser):
    """Addresses the page itself asked for since it was asked last."""
    events = [json.loads(e["message"])["message"] for e in browser.get_log("performance")]
    sent = (e["params"] for e in events if e["method"] == "Network.requestWillBeSent")
    return {event["request"]["url"] for event in sent}
