"""`run --map` and `map ...`: maps from one day to the next."""

import json

import numpy as np
import pytest
import recordings

from multi_robot_slam.cli.maps import FILE
from multi_robot_slam.filter.settings import RejuvenationSettings
from sim_world.scenario import Scenario


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps") / "bag"
    rest = RejuvenationSettings(ancestors_below=0.5, unknowns=300)
    scenario = Scenario(robots=2, observations=10)
    recordings.record(folder, scenario, steps=50, particles=60, rejuvenation=rest)
    return folder


@pytest.fixture
def first(command, bag, tmp_path):
    assert command("run", bag, "--out", tmp_path / "first")[0] == 0
    return tmp_path / "first" / FILE


def figures(folder):
    return json.loads((folder / "result.json").read_text())


def arrays(file):
    with np.load(file) as archive:
        return {name: archive[name] for name in archive if name.startswith("map/")}


def test_the_next_day_robots_know_where_they_are(command, bag, first, tmp_path):
    code, _, told = command("run", bag, "--map", first, "--out", tmp_path / "next")
    assert (code, told) == (0, "")
    day, next_day = figures(tmp_path / "first"), figures(tmp_path / "next")
    assert next_day["online_path_rmse_m"] < day["online_path_rmse_m"]
    before, after = arrays(first), arrays(tmp_path / "next" / FILE)
    assert after["map/observations"].sum() > 1.5 * before["map/observations"].sum()
    assert command("evaluate", tmp_path / "next")[0] == 0


def test_who_only_looks_leaves_the_map_as_it_was(command, bag, first, tmp_path):
    words = ("--map", first, "--set", "filter.mapping=false")
    assert command("run", bag, *words, "--out", tmp_path / "next")[0] == 0
    after = arrays(tmp_path / "next" / FILE)
    for name, array in arrays(first).items():
        assert after[name].tobytes() == array.tobytes()
    day, next_day = figures(tmp_path / "first"), figures(tmp_path / "next")
    assert next_day["online_path_rmse_m"] < day["online_path_rmse_m"]
    assert command("evaluate", tmp_path / "next")[0] == 0


@pytest.mark.parametrize("mapping", ["true", "false"])
def test_robots_start_anywhere_in_a_map(command, bag, first, tmp_path, mapping):
    anywhere = ("--set", "start_poses=[unknown, unknown]", "--set", f"filter.mapping={mapping}")
    assert command("run", bag, *anywhere, "--map", first, "--out", tmp_path / "next")[0] == 0
    found = figures(tmp_path / "next")
    assert found["online_path_rmse_m"] < 1.3 * figures(tmp_path / "first")["online_path_rmse_m"]
    assert command("evaluate", tmp_path / "next")[0] == 0


def test_two_maps_are_merged(command, bag, first, tmp_path):
    """Of the same map there is nothing to learn; of what goes back to it too much."""
    code, told, _ = command("map", "merge", first, first, "--out", tmp_path / "c.npz")
    assert code == 0
    assert "both are the same map" in told
    for name, array in arrays(first).items():
        assert (arrays(tmp_path / "c.npz")[name] == array).all()
    assert "exists" in command("map", "merge", first, first, "--out", tmp_path / "c.npz")[2]
    assert command("run", bag, "--map", first, "--out", tmp_path / "next")[0] == 0
    words = ("map", "merge", first, tmp_path / "next" / FILE, "--out", tmp_path / "d.npz")
    code, _, told = command(*words)
    assert (code, told.count("\n")) == (2, 1)
    assert "would count twice" in told
    scenario = Scenario(robots=2, observations=10)
    recordings.record(tmp_path / "again", scenario, seed=9, steps=50, particles=60)
    assert command("run", tmp_path / "again", "--out", tmp_path / "other")[0] == 0
    words = ("map", "merge", first, tmp_path / "other" / FILE, "--out", tmp_path / "d.npz")
    code, told, _ = command(*words)
    assert code == 0
    assert "the second map lies at [" in told
    assert "landmarks are in both, and one from now on" in told
    count = len(arrays(tmp_path / "d.npz")["map/ids"])
    assert f", {count} in all" in told
    assert command("map", "info", tmp_path / "d.npz")[0] == 0


def test_a_map_is_described_and_exported(command, first, tmp_path):
    code, told, _ = command("map", "info", first)
    assert code == 0
    assert command("map", "info", first.parent)[1] == told
    held = arrays(first)
    count = int(held["map/published"].sum())
    assert f"landmarks: {count} published, {len(held['map/ids'])} in all" in told
    assert "robots: robot_1, robot_2" in told
    code, told, _ = command("map", "export", first, "--out", tmp_path / "out")
    assert (code, "Everything is in" in told) == (0, True)
    rows = (tmp_path / "out" / "map.csv").read_text().splitlines()
    assert len(rows) == count + 1
    assert f"element vertex {count}".encode() in (tmp_path / "out" / "map.ply").read_bytes()
    assert "start_poses" in (tmp_path / "out" / "config.yaml").read_text()


def test_what_cannot_be_is_refused(command, bag, first, tmp_path):
    out = tmp_path / "out"
    anywhere = ("--set", "start_poses=[unknown, unknown]")
    for words, remedy in (
        (("run", bag, "--out", out, "--map", tmp_path / "no"), "no file"),
        (("run", bag, "--out", out, "--map", bag), "holds no map.npz"),
        (("run", bag, "--out", out, "--map", first, "--refine"), "leave out one"),
        (("run", bag, "--out", out, "--set", "filter.mapping=false"), "no map to localise in"),
        (("run", bag, "--out", out, *anywhere), "or load a map"),
        (("map", "info", tmp_path / "no"), "no file"),
        (("map", "export", first, "--out", tmp_path / "first"), "exists"),
    ):
        code, _, told = command(*words)
        assert (code, told.count("\n")) == (2, 1), told
        assert remedy in told
    assert not out.exists()
