"""Slider, speed and pause; and where a page is served."""

import socket
from types import SimpleNamespace

import pytest

from msg_defs.errors import InputError
from multi_robot_slam.watch import address
from multi_robot_slam.watch.address import Address, Serving
from multi_robot_slam.watch.page import Page
from multi_robot_slam.watch.playing import Player
from multi_robot_slam.watch.recording import Recording
from test.watch import published


class Clock:
    now_s = 0.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def playing(tmp_path):
    """A player of 1.9 s, the clock it goes by, and what it had shown [s]."""
    published.record(tmp_path / "bag")
    recording, clock = Recording(tmp_path / "bag"), Clock()
    page = Page(address.free(Serving(port=18080)))
    asked = []
    at = recording.at
    recording.at = lambda ns: (asked.append((ns - recording.begin_ns) / 1e9), at(ns))[1]
    player = Player(page, recording, clock)

    def after(seconds):
        clock.now_s += seconds
        player.work()
        return asked[-1]

    yield SimpleNamespace(player=player, after=after)
    page.close()


def test_it_plays_to_the_end_and_stays_there(playing):
    shown = [playing.after(seconds) for seconds in (0.0, 0.5, 0.5, 2.0, 2.0)]
    assert shown == pytest.approx([0.0, 0.5, 1.0, 1.9, 1.9])
    assert playing.player.slider.value == 1.9


def test_it_goes_where_the_slider_is_put_and_goes_on_from_there(playing):
    playing.after(1.0)
    playing.player.slider.value = 0.3
    assert playing.after(0.0) == pytest.approx(0.3)
    assert playing.after(0.4) == pytest.approx(0.7)
    playing.after(9.0)
    playing.player.slider.value = 0.5
    assert playing.after(0.2) == pytest.approx(0.5)
    assert playing.after(0.2) == pytest.approx(0.7)


def test_it_stands_still_while_it_pauses_but_for_the_slider(playing):
    playing.after(0.5)
    playing.player.pause.value = True
    assert playing.after(0.0) == playing.after(3.0) == pytest.approx(0.5)
    playing.player.slider.value = 1.2
    assert playing.after(1.0) == playing.after(1.0) == pytest.approx(1.2)
    playing.player.pause.value = False
    playing.after(0.0)
    assert playing.after(0.3) == pytest.approx(1.5)


def test_it_changes_its_speed_where_it_is(playing):
    playing.after(0.5)
    playing.player.speed.value = "0.5"
    assert playing.after(0.0) == pytest.approx(0.5)
    assert playing.after(1.0) == pytest.approx(1.0)
    playing.player.speed.value = "10"
    playing.after(0.0)
    assert playing.after(0.05) == pytest.approx(1.5)


def test_it_begins_again_where_it_is_played_at_the_end(playing):
    playing.after(5.0)
    playing.player.slider.value = 0.0
    assert playing.after(0.0) == 0.0


def test_a_port_in_use_is_passed_over():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        found = address.free(Serving(port=port))
        assert found.port > port


def test_without_a_free_port_it_is_said(monkeypatch):
    monkeypatch.setattr(address, "_is_free", lambda host, port: False)
    with pytest.raises(InputError, match="port = 65500: all up to 65535 are in use; name another"):
        address.free(Serving(port=65500))


@pytest.mark.parametrize("host", ["no such host", "203.0.113.7"])
def test_an_address_of_no_machine_or_another_is_refused(host):
    with pytest.raises(InputError, match=f"host = {host}: .*; give an address of this machine"):
        address.free(Serving(host=host))


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1"])
def test_this_machine_alone_needs_no_warning(host):
    assert Address(host, 8080).warning == ""


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5"])
def test_other_addresses_need_one(host):
    warning = Address(host, 8080).warning
    assert "without password" in warning
    assert str(Address(host, 8080)) in warning


def test_addresses_can_be_opened():
    assert str(Address("127.0.0.1", 8081)) == "http://127.0.0.1:8081"
    assert str(Address("::1", 8081)) == "http://[::1]:8081"
    assert str(Address("0.0.0.0", 80)) == f"http://{socket.gethostname()}:80"


def test_without_viser_the_remedy_is_said(monkeypatch):
    monkeypatch.setattr(address, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"no module 'viser'.*pip install viser"):
        address.require_viser()
