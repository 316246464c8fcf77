"""The package as pip installs it: what `ros2 run`, a user of the commands and the code find."""

import configparser
import filecmp
import os
import shutil
import subprocess
import sys
import sysconfig
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from patience import PATIENCE_S

ROOT = Path(__file__).parents[2]
EXECUTABLES = [
    ("sim_world", "robots"),
    ("multi_robot_slam", "camera"),
    ("multi_robot_slam", "fusion"),
    ("multi_robot_slam", "record"),
    ("multi_robot_slam", "replay"),
    ("multi_robot_slam", "watch"),
]
NEED_NOTHING = [each for each in EXECUTABLES if each[1] != "replay"]
"""Nodes that run without parameters; a replay needs a bag."""


@pytest.fixture(scope="session")
def prefix(tmp_path_factory):
    """An environment of its own, with a regular install; dependencies come from this one."""
    folder = tmp_path_factory.mktemp("installed")
    source, prefix = folder / "source", folder / "environment"
    unwanted = shutil.ignore_patterns(".*", "build", "install", "log", "*.egg-info")

    def left_out(directory, names):
        return {*unwanted(directory, names), *(["runs"] if Path(directory) == ROOT else [])}

    shutil.copytree(ROOT, source, symlinks=True, ignore=left_out)
    _run(sys.executable, "-m", "venv", "--without-pip", prefix)
    python = prefix / "bin" / "python3"
    site_packages = _run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))")
    Path(site_packages.strip(), "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    # This environment's editable install would count as installed there.
    options = ("--no-deps", "--no-index", "--no-build-isolation", "--ignore-installed")
    _run(sys.executable, "-m", "pip", "--python", python, "install", *options, source)
    return prefix


def _run(*command, **options):
    finished = subprocess.run(
        [str(word) for word in command],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        **options,
    )
    assert finished.returncode == 0, finished.stdout + finished.stderr
    return finished.stdout


def _as_ros2_run_finds_it(prefix, monkeypatch, package, executable):
    ament_index_python = pytest.importorskip("ament_index_python")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(prefix))
    return Path(ament_index_python.get_package_prefix(package), "lib", package, executable)


@pytest.mark.parametrize(("package", "executable"), EXECUTABLES)
def test_ros2_run_finds_an_executable(prefix, monkeypatch, package, executable):
    path = _as_ros2_run_finds_it(prefix, monkeypatch, package, executable)
    assert path.is_relative_to(prefix)
    assert os.access(path, os.X_OK)


@pytest.mark.parametrize(("package", "executable"), EXECUTABLES)
def test_executable_runs_the_installed_code(prefix, tmp_path, package, executable):
    # A python3 in the environment's place reports how it is called.
    copy = tmp_path / "lib" / package / executable
    copy.parent.mkdir(parents=True)
    shutil.copy(prefix / "lib" / package / executable, copy)
    python = tmp_path / "bin" / "python3"
    python.parent.mkdir()
    python.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    python.chmod(0o755)
    _, module, *arguments = _run(copy, "--ros-args", "-p", "a:=b c").splitlines()
    assert arguments == ["--ros-args", "-p", "a:=b c"]
    spec = f"import importlib.util; print(importlib.util.find_spec({module!r}).origin)"
    origin = _run(prefix / "bin" / "python3", "-c", spec, cwd=tmp_path).strip()
    assert Path(origin).is_relative_to(prefix)


@pytest.mark.parametrize(("package", "executable"), NEED_NOTHING)
def test_node_comes_up_and_ends_cleanly(prefix, monkeypatch, spawn, tmp_path, package, executable):
    pytest.importorskip("rclpy")
    path = _as_ros2_run_finds_it(prefix, monkeypatch, package, executable)
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")  # to compile it all anew takes half a minute
    process = spawn(path, cwd=tmp_path)
    assert _a_node_appears(process)
    process.terminate()
    assert process.wait(PATIENCE_S) == 0


def _a_node_appears(process, timeout_s=PATIENCE_S):
    import rclpy

    deadline = time.monotonic() + timeout_s
    with rclpy.Context() as context:
        observer = rclpy.create_node("observer", context=context)
        while time.monotonic() < deadline and process.poll() is None:
            if set(observer.get_node_names()) - {"observer"}:
                return True
            time.sleep(0.1)
    return False


@pytest.mark.parametrize("command", ["sim_world", "multi_robot_slam"])
def test_command_starts(prefix, command, tmp_path):
    assert "Usage" in _run(prefix / "bin" / command, "--help", cwd=tmp_path)


def test_configuration_is_found_from_code_and_in_share(prefix, tmp_path):
    locate = "import msg_defs; print(msg_defs.__path__[0])"
    package = Path(_run(prefix / "bin" / "python3", "-c", locate, cwd=tmp_path).strip())
    assert package.is_relative_to(prefix)
    share = prefix / "share" / "multi_robot_slam" / "config"
    for file in (ROOT / "config").iterdir():
        assert filecmp.cmp(file, share / file.name, shallow=False)
        if file.suffix == ".yaml":
            assert filecmp.cmp(file, package / "config" / file.name, shallow=False)
            assert filecmp.cmp(file, ROOT / "msg_defs" / "config" / file.name, shallow=False)


def test_ros2_launch_finds_the_launch_files(prefix):
    share = prefix / "share" / "multi_robot_slam" / "launch"
    assert [file.name for file in share.glob("*.py")] == ["team.launch.py"]
    for file in (ROOT / "launch").glob("*.launch.py"):
        assert filecmp.cmp(file, share / file.name, shallow=False)


def test_every_module_and_data_file_is_installed(prefix, tmp_path):
    locate = "import msg_defs; print(msg_defs.__path__[0])"
    installed = Path(_run(prefix / "bin" / "python3", "-c", locate, cwd=tmp_path).strip()).parent
    for package in ("msg_defs", "sim_world", "multi_robot_slam"):
        for file in (ROOT / package).rglob("*"):
            if file.is_file() and "__pycache__" not in file.parts:
                assert (installed / file.relative_to(ROOT)).is_file()


MANIFESTS = {"multi_robot_slam": "package.xml", "sim_world": "resource/share/sim_world/package.xml"}


@pytest.mark.parametrize("package", MANIFESTS)
def test_ros2_pkg_xml_finds_the_manifest(prefix, monkeypatch, package):
    ament_index_python = pytest.importorskip("ament_index_python")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(prefix))
    share = Path(ament_index_python.get_package_share_directory(package))
    assert filecmp.cmp(share / "package.xml", ROOT / MANIFESTS[package], shallow=False)


@pytest.mark.parametrize("package", MANIFESTS)
def test_package_xml_agrees_with_setup_cfg(package):
    manifest = ElementTree.parse(ROOT / MANIFESTS[package]).getroot()
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    assert manifest.findtext("name") == package
    assert manifest.findtext("version") == setup["metadata"]["version"]
    assert manifest.findtext("license") == setup["metadata"]["license"]
