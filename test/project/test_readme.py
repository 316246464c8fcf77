"""What the README and the tutorial show works as shown."""

import re
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pictures
import pytest
import recordings
from patience import PATIENCE_S

from msg_defs import scenario_file
from multi_robot_slam.config import SECTION, Config

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
TUTORIAL = (ROOT / "docs" / "tutorial.md").read_text()
QUICK = {
    ("multi_robot_slam", verb) for verb in ("run", "evaluate", "compare", "report", "export", "map")
}
QUICK |= {("sim_world", "team"), ("sim_world", "descriptors"), ("sim_world", "generate")}
LONG = {("multi_robot_slam", verb) for verb in ("demo", "landmarks", "study", "convert")}
LONG |= {("sim_world", "generate --images")}
"""They take minutes, or a recording that the README does not bring: only their help is asked."""
GROUPS = ("study", "convert")


def blocks(language, page=README):
    return re.findall(rf"^```{language}\n(.*?)^```", page, re.MULTILINE | re.DOTALL)


def commands():
    """Every command line shown, as words: the README's, then the tutorial's."""
    lines = "".join([*blocks("sh"), *blocks("sh", TUTORIAL)]).splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with all that the commands read."""
    recordings.record(tmp_path / "runs" / "latest" / "bag", is_live=True)
    (tmp_path / "photos").mkdir()
    pixels = np.random.default_rng(0).integers(0, 256, (40, 40), np.uint8)
    photo = cv2.resize(pixels, (240, 240), interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(tmp_path / "photos" / "texture.png"), photo)
    (tmp_path / "my_team.yaml").write_text(blocks("yaml")[0])
    config = scenario_file.from_yaml(Config, blocks("yaml")[0], SECTION)
    few = ((stamp, *rest) for robot in config.robots for stamp, *rest in pictures.drive(robot, 4))
    pictures.record(tmp_path / "rosbag2_yours", config, sorted(few, key=lambda m: m[0]), False)
    shutil.copytree(tmp_path / "rosbag2_yours", tmp_path / "rosbag2_next_day")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(words):
    """Run a command as a shell would, `> file` included."""
    program, *arguments = words
    output = None
    if ">" in arguments:
        *arguments, _, output = arguments
    module = f"{program}.cli"
    result = subprocess.run(
        [sys.executable, "-m", module, *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert result.returncode == 0, result.stderr
    if output:
        Path(output).write_text(result.stdout)


def serve(words):
    """Run a command until it has said where its page is, and end it as Ctrl-C does."""
    program, *arguments = words
    command = [sys.executable, "-m", f"{program}.cli", *arguments]
    pipe = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(command, **pipe) as process:
        said = []
        for line in process.stdout:
            said.append(line)
            if "http://127.0.0.1:" in line:
                process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0, "".join(said)
        assert "http://127.0.0.1:" in "".join(said)


def in_place_of_nothing(bag):
    """What a recorder would have left that had heard a team."""
    shutil.rmtree(bag)
    recordings.record(bag, is_live=True)


def test_every_command_works_as_shown(folder, ros_domain_id):
    nodes = pytest.importorskip("nodes")
    from multi_robot_slam.nodes import camera, fusion, recorder, replay
    from sim_world import robots

    makers = {"fusion": fusion.Fusion, "record": recorder.Recorder, "robots": robots.SimWorld}
    makers |= {"replay": replay.Replay, "camera": camera.CameraNode}
    for program, *arguments in commands():
        verb = arguments[0]
        key = program, " ".join(arguments[:2]) if "--images" in arguments[:2] else verb
        if program == "make":
            subprocess.run(["make", "-n", verb], cwd=ROOT, check=True, capture_output=True)
        elif key in QUICK:
            run([program, *arguments])
        elif verb == "watch":
            serve([program, *arguments])
        elif key in LONG or (program, verb) in LONG:
            options = [word for word in arguments if word.startswith("--")]
            named = arguments[: 2 if verb in GROUPS else 1]
            told = subprocess.check_output(
                [sys.executable, "-m", f"{program}.cli", *named, "--help"], text=True
            )
            assert all(option in told for option in options)
        else:
            given = arguments[arguments.index("--ros-args") + 1 :]
            with nodes.ros(*given):
                makers[verb]().close()
            if "out:=drive" in given:
                in_place_of_nothing(folder / "drive")


@pytest.mark.parametrize("page", [README, TUTORIAL], ids=["README", "tutorial"])
def test_the_scenario_shown_is_one(page):
    (text,) = blocks("yaml", page)
    config = scenario_file.from_yaml(Config, text, SECTION)
    assert config.robots == ("alice", "bob")


def test_everything_linked_and_named_is_there():
    linked = re.findall(r"\]\(([^)#:]+)\)", README)
    named = re.findall(r"`((?:config|docs|examples)/[\w./]+)`", README)
    assert [name for name in linked + named if not (ROOT / name).exists()] == []
    picture = ROOT / "docs" / "report.png"
    assert picture.stat().st_size < 300_000


def test_every_file_that_the_documents_name_is_there():
    """Paths in backticks that end in .py, from the top or from a package."""
    roots = [ROOT, ROOT / "multi_robot_slam"]
    lost = []
    for document in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        for name in re.findall(r"`((?:[\w.]+/)+\w+\.(?:py|xml))`", document.read_text()):
            if not any((root / name).exists() for root in roots):
                lost.append(f"{document.name}: {name}")
    assert lost == []
