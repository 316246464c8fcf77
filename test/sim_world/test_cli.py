"""The command `sim_world`."""

import functools
import re
import sys
from importlib import metadata
from types import ModuleType

import cv2
import numpy as np
import pytest

import msg_defs.cli
from msg_defs.errors import InputError
from sim_world import cli, descriptors


@pytest.fixture
def sim_world(program):
    """Run the command: `sim_world(word, ...) -> (exit code, stdout, stderr)`."""
    return functools.partial(program, cli)


@pytest.fixture
def texture(tmp_path):
    path = tmp_path / "images" / "texture.png"
    path.parent.mkdir()
    pixels = np.random.default_rng(0).integers(0, 256, (40, 40), np.uint8)
    cv2.imwrite(str(path), cv2.resize(pixels, (240, 240), interpolation=cv2.INTER_CUBIC))
    return path


def refused(result):
    """The one line on stderr of a command that refused its input."""
    code, out, err = result
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("error: ")
    return err


@pytest.mark.parametrize("folder", [True, False])
def test_descriptors_of_images_and_folders(sim_world, texture, tmp_path, folder):
    out = tmp_path / "database"
    code, printed, _ = sim_world("descriptors", texture.parent if folder else texture, "--out", out)
    rows = descriptors.load(out)
    assert code == 0
    assert printed == f"{len(rows)} descriptors in {out}\n"
    assert len(rows) == len(descriptors.build([texture]))


def test_existing_output_is_kept(sim_world, texture, tmp_path):
    out = tmp_path / "database.npz"
    out.write_text("precious")
    assert "database.npz exists" in refused(sim_world("descriptors", texture, "--out", out))
    assert out.read_text() == "precious"


def test_bad_input_leaves_no_output(sim_world, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.png").write_text("not an image")
    out = tmp_path / "out.npz"
    for image, message in (
        ("missing.png", "does not exist"),
        ("empty", "no images in"),
        ("text.png", "cannot read"),
    ):
        assert message in refused(sim_world("descriptors", tmp_path / image, "--out", out))
    assert not out.exists()


def test_unwritable_output_is_named(sim_world, texture, tmp_path):
    out = tmp_path / "no" / "folder.npz"
    assert "cannot write" in refused(sim_world("descriptors", texture, "--out", out))


def test_robots_passes_its_arguments_on(sim_world, monkeypatch):
    given = []
    node = ModuleType("sim_world.robots")
    node.main = lambda args: given.extend(args) or 3
    monkeypatch.setitem(sys.modules, "sim_world.robots", node)
    words = ["--ros-args", "-p", "robots:=2", "-r", "__ns:=/team", "--params-file", "f.yaml"]
    code, *_ = sim_world("robots", *words)
    assert given == words
    assert code == 3


def test_robots_without_ros_says_what_is_missing(sim_world, monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert "no module 'rclpy" in refused(sim_world("robots"))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], ["descriptors", "robots", "generate"]),
        (["generate"], ["--robots", "--seed", "--rate", "--laps", "--out", "75 s"]),
        (["descriptors"], ["IMAGES", "--out", "descriptor_database"]),
        (["robots"], ["--ros-args", "scenario:="]),
    ],
)
def test_help_teaches(sim_world, words, told):
    code, out, _ = sim_world(*words, "--help")
    assert code == 0
    plain = re.sub(r"\x1b\[[0-9;]*m", "", out)
    assert all(word in plain for word in told)


def test_version_is_that_of_the_package(sim_world):
    code, told, _ = sim_world("--version")
    assert (code, told) == (0, f"multi_robot_slam {metadata.version('multi_robot_slam')}\n")


def test_wrong_words_end_with_code_2(sim_world):
    assert sim_world("fly")[0] == 2


def test_input_errors_become_one_line(capsys):
    def app():
        raise InputError("a = 1: too small\nb = 2: too large")

    with pytest.raises(SystemExit) as end:
        msg_defs.cli.run(app)
    assert end.value.code == 2
    assert capsys.readouterr() == ("", "error: a = 1: too small; b = 2: too large\n")


def test_other_errors_are_not_hidden():
    def app():
        raise KeyError("a fault of ours")

    with pytest.raises(KeyError):
        msg_defs.cli.run(app)
