"""The command `multi_robot_slam`, where no ROS is needed."""

import json
import sys
from importlib import metadata

import pytest
import recordings

from msg_defs import scenario_file, topics, wire
from msg_defs.topics import Topic
from multi_robot_slam.bags import BagReader, BagWriter
from multi_robot_slam.cli import main
from multi_robot_slam.config import SECTION, Config


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags") / "simulated"
    recordings.record(folder)
    return folder


def refused(result):
    """The one line on stderr of a command that refused its input."""
    code, out, err = result
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert err.startswith("error: ")
    return err


def test_run_leaves_results_and_prints_the_table(command, bag, tmp_path):
    out = tmp_path / "out"
    code, printed, _ = command("run", bag, "--out", out)
    assert code == 0
    assert "robot_2" in printed
    result = json.loads((out / "result.json").read_text())
    assert (result["steps"], result["particles"], result["dropped"]) == (21, 20, {})
    assert result["path_rmse_m"] < 1
    assert result["map_rmse_m"] < 1
    written = {path.name for path in out.iterdir()}
    robots = ("robot_1", "robot_2")
    trajectories = {f"{kind}_{robot}.tum" for kind in ("trajectory", "truth") for robot in robots}
    figures = {"result.json", "figures.csv"}
    assert written == {"config.yaml", "map.csv", "map.npz", "estimates"} | trajectories | figures


def test_pictures_and_the_yardstick_come_with_evaluate(command, bag, tmp_path):
    out = tmp_path / "out"
    command("run", bag, "--out", out)
    assert json.loads((out / "result.json").read_text())["batch_path_rmse_m"] is None
    assert command("evaluate", out)[0] == 0
    assert 0 < json.loads((out / "result.json").read_text())["batch_path_rmse_m"] < 1
    assert {"map.png", "errors.png"} <= {path.name for path in out.iterdir()}


def test_offline_run_is_judged_again_with_the_same_result(command, bag, tmp_path):
    out = tmp_path / "out"
    assert command("run", bag, "--out", out, "--refine")[0] == 0
    before = {file: file.read_bytes() for file in out.glob("*_robot_?.tum")}
    first = json.loads((out / "result.json").read_text())
    assert first["refined_path_rmse_m"] is not None
    assert command("evaluate", out)[0] == 0
    again = json.loads((out / "result.json").read_text())
    assert again.pop("bag") == first.pop("bag") == str(bag)
    for key in ("namespace", "version", "scenario", "machine"):
        assert again.pop(key) == first.pop(key)
    ours, theirs = (figures.pop("robots") | {"team": figures} for figures in (first, again))
    for who, figures in ours.items():
        for name, value in figures.items():
            if value is None and name.startswith("batch_"):
                continue  # the yardstick is computed by `evaluate` alone
            is_text = value is None or isinstance(value, str)
            expected = value if is_text else pytest.approx(value, abs=1e-9, rel=1e-9)
            assert theirs[who][name] == expected, (who, name)
    assert {file: file.read_bytes() for file in out.glob("*_robot_?.tum")} == before


def test_runs_are_compared_and_exported(command, bag, tmp_path):
    outs = [tmp_path / name for name in ("one", "two")]
    for out, particles in zip(outs, ("5", "20"), strict=True):
        command("run", bag, "--out", out, "--particles", particles)
    code, printed, _ = command("compare", *outs, "--csv", tmp_path / "both.csv")
    assert code == 0
    assert "filter.particles: 5 | 20" in printed
    assert (tmp_path / "both.csv").read_text().startswith("robot,figure,")
    for name in ("tum", "g2o", "ply"):
        code, printed, _ = command("export", outs[0], "--to", name, "--out", tmp_path / name)
        assert (code, (tmp_path / name).exists()) == (0, True)
        assert "Everything is in" in printed


def test_live_run_and_run_of_its_bag_are_judged_alike(command, tmp_path):
    live, again = tmp_path / "live", tmp_path / "again"
    recordings.record(live / "bag", is_live=True)
    assert command("evaluate", live)[0] == 0
    assert command("run", live / "bag", "--out", again)[0] == 0
    judged, estimated = (json.loads((f / "result.json").read_text()) for f in (live, again))
    for name in ("path_rmse_m", "heading_rmse_rad", "map_rmse_m", "landmarks"):
        assert judged[name] == pytest.approx(estimated[name], abs=1e-9)


def test_run_takes_particles_seed_and_scenario(command, bag, tmp_path):
    scenario = tmp_path / "given.yaml"
    scenario.write_text("multi_robot_slam: {filter: {gate: 9.0, particles: 4}}")
    out = tmp_path / "out"
    words = ("--scenario", scenario, "--particles", "7", "--set", "seed=3")
    assert command("run", bag, "--out", out, *words)[0] == 0
    config = scenario_file.from_file(Config, out / "config.yaml", SECTION)
    assert (config.filter.gate, config.filter.particles, config.seed) == (9.0, 7, 3)
    assert config.robots == ("robot_1", "robot_2")


def test_version_is_that_of_the_package(command):
    code, told, _ = command("--version")
    assert (code, told) == (0, f"multi_robot_slam {metadata.version('multi_robot_slam')}\n")


@pytest.mark.parametrize("study", ["experiment", "accuracy", "real", "bench"])
def test_every_study_takes_its_first_seed(command, study):
    code, told, _ = command("study", study, "--help")
    assert code == 0
    assert "--first-seed" in told


@pytest.mark.parametrize("former", ["experiment", "accuracy", "real"])
def test_studies_are_in_their_group_alone(command, former):
    assert command(former, "--help")[0] == 2


def completed(monkeypatch, capfd, *words):
    """What a shell would offer for the last of the words."""
    monkeypatch.setenv("_MULTI_ROBOT_SLAM_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", " ".join(("multi_robot_slam", *words)))
    monkeypatch.setenv("COMP_CWORD", str(len(words)))
    with pytest.raises(SystemExit):
        main.app(prog_name="multi_robot_slam")
    return capfd.readouterr().out.split()


def test_the_shell_completes_verbs_and_values(monkeypatch, capfd, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "first").mkdir(parents=True)
    (tmp_path / "mine.yaml").touch()
    for words, offered in (
        (("ev",), ["evaluate"]),
        (
            ("study", ""),
            [
                "experiment",
                "accuracy",
                "hard",
                "real",
                "cameras",
                "front-end",
                "descriptors",
                "hours",
                "latency",
                "bench",
            ],
        ),
        (("demo", "--scenario", ""), ["calibrated", "cameras", "paper", "mine.yaml"]),
        (("evaluate", ""), ["runs/first"]),
        (("run", "bag", "--set", "reord"), ["reorder_window_s="]),
    ):
        assert completed(monkeypatch, capfd, *words) == offered


def test_of_two_teams_in_one_bag_one_is_chosen(command, bag, tmp_path):
    both, out = tmp_path / "both", tmp_path / "out"
    with BagWriter(both) as writer:
        for record in BagReader(bag):
            for namespace in ("/red", "/blue"):
                topic = Topic(f"{namespace}{record.topic}", record.type)
                writer.write(topic, record.stamp_ns, record.data)
    assert "choose one: --namespace /red" in refused(command("run", both))
    words = ("--namespace", "blue", "--scenario", "paper", "--particles", "20")
    assert command("run", both, "--out", out, *words)[0] == 0
    result = json.loads((out / "result.json").read_text())
    assert (result["namespace"], result["scenario"], result["steps"]) == ("/blue", "paper", 21)
    assert command("evaluate", out)[0] == 0
    assert json.loads((out / "result.json").read_text())["namespace"] == "/blue"


def test_the_same_bag_gives_the_same_figures(command, bag, tmp_path):
    outs = [tmp_path / "a", tmp_path / "b"]
    figures = []
    for out in outs:
        command("run", bag, "--out", out)
        result = json.loads((out / "result.json").read_text())
        figures.append({k: v for k, v in result.items() if not k.startswith("step_ms")})
    assert figures[0] == figures[1]
    assert (outs[0] / "map.csv").read_bytes() == (outs[1] / "map.csv").read_bytes()


def test_damaged_messages_are_dropped_and_counted_as_the_fusion_does(command, bag, tmp_path):
    damaged = tmp_path / "damaged"
    by_name = {f"/{t.name}": t for t in (topics.FUSION_CONFIG, *map(topics.odometry, ROBOTS))}
    by_name |= {f"/{t.name}": t for t in map(topics.observations, ROBOTS)}
    with BagWriter(damaged) as writer:
        for record in BagReader(bag):
            if record.topic in by_name:
                writer.write(by_name[record.topic], record.stamp_ns, record.data)
        writer.write(topics.observations("robot_1"), record.stamp_ns, wire.encode_text("x" * 60))
    out = tmp_path / "out"
    code, _, err = command("run", damaged, "--out", out)
    assert code == 0
    assert "observations of robot_1" in err
    result = json.loads((out / "result.json").read_text())
    assert result["dropped"] == {"bad observations of robot_1": 1}
    assert result["steps"] == 21
    assert result["path_rmse_m"] is None


ROBOTS = ("robot_1", "robot_2")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("run", "{bag}", "--out", "{bag}"), "exists"),
        (("run", "{tmp}/nowhere"), "no bag"),
        (("run", "{tmp}"), "no .mcap file"),
        (("run", "{bag}", "--scenario", "nowhere"), "no scenario 'nowhere'"),
        (("run", "{bag}", "--scenario", "{tmp}/noise.yaml"), "no text file"),
        (("run", "{bag}", "--scenario", "{tmp}/others.yaml"), "none of a, b"),
        (("run", "{bag}", "--set", "filter.particels=9"), "similar are filter.particles"),
        (("run", "{bag}", "--set", "seed=1", "--seed", "2"), "given twice"),
        (("run", "{bag}", "--scenario", "{tmp}/twice.yaml"), "name each robot of the team once"),
        (("evaluate", "{bag}"), "holds no estimates"),
        (("evaluate", "{tmp}/nowhere"), "no run"),
        (("compare", "{tmp}"), "name two folders or more"),
        (("compare", "{tmp}", "{tmp}"), "cannot read"),
        (("export", "{tmp}/nowhere", "--to", "ply", "--out", "{tmp}/x"), "no run"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(command, bag, tmp_path, words, told):
    (tmp_path / "noise.yaml").write_bytes(b"\xff\xfe\x00\x9d")
    (tmp_path / "others.yaml").write_text("multi_robot_slam: {robots: [a, b]}")
    (tmp_path / "twice.yaml").write_text("multi_robot_slam: {robots: [robot_1, robot_1]}")
    filled = [word.format(bag=bag, tmp=tmp_path) for word in words]
    assert told in refused(command(*filled))


@pytest.mark.parametrize("given", [True, False], ids=["out", "runs"])
def test_a_bag_that_is_refused_leaves_no_folder(command, tmp_path, monkeypatch, given):
    """The configuration is there and the robots are not, which shows only when the bag is read."""
    monkeypatch.chdir(tmp_path)
    with BagWriter(tmp_path / "silent") as writer:
        text = scenario_file.to_yaml(**{SECTION: Config()})
        writer.write(topics.FUSION_CONFIG, 1, wire.encode_text(text))
    words = ("--out", "out") if given else ()
    for _ in range(2):
        assert "nothing to estimate from" in refused(command("run", "silent", *words))
    assert not (tmp_path / "out").exists()
    assert list(tmp_path.glob("runs/*")) == []


def test_nodes_without_ros_say_what_is_missing(command, monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    for verb in ("demo", "fusion", "record", "replay"):
        assert "no module 'rclpy'" in refused(command(verb))
