"""A bag through the pipeline: whatever namespace it was recorded in, the estimate is the same."""

import numpy as np
import pytest
import recordings

from msg_defs import topics
from msg_defs.errors import InputError
from multi_robot_slam import runs
from multi_robot_slam.bags import BagReader, BagWriter, absolute
from multi_robot_slam.pipeline import offline
from sim_world.scenario import Scenario

SCENARIO = Scenario(robots=2, movements=12, observations=5)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags") / "bag"
    recordings.record(folder, SCENARIO)
    return folder


def moved_into(bag, folder, *namespaces):
    """The recording once in each of the namespaces."""
    with BagWriter(folder) as copy:
        for record in BagReader(bag):
            for namespace in namespaces:
                name = absolute(record.topic.removeprefix("/"), namespace)
                copy.write(topics.Topic(name, record.type), record.stamp_ns, record.data)
    return folder


@pytest.mark.parametrize("namespace", ["/fleet", "/site_1/fleet"])
def test_a_bag_in_a_namespace_is_estimated_as_one_at_the_root(command, bag, tmp_path, namespace):
    config = offline.recorded_config(bag)
    expected = offline.estimate(bag, config, warn=pytest.fail)
    elsewhere = moved_into(bag, tmp_path / "bag", namespace)
    assert offline.recorded_config(elsewhere) == config
    run = offline.estimate(elsewhere, config, warn=pytest.fail)
    assert run.namespace == namespace
    for name, robot in expected.robots.items():
        np.testing.assert_array_equal(run.robots[name].path.poses, robot.path.poses)
        np.testing.assert_array_equal(run.robots[name].truth.poses, robot.truth.poses)
        np.testing.assert_array_equal(run.robots[name].odometry.poses, robot.odometry.poses)
    assert command("run", elsewhere, "--out", tmp_path / "out")[0] == 0
    again = offline.load(tmp_path / "out")
    assert again.namespace == namespace
    assert runs.evaluate(again)["path_rmse_m"] == runs.evaluate(expected)["path_rmse_m"]


def test_of_two_namespaces_one_must_be_chosen(bag, tmp_path):
    both = moved_into(bag, tmp_path / "bag", "/a", "/b/c")
    config = offline.recorded_config(bag)
    told = r"namespaces /a, /b/c; choose one: --namespace"
    with pytest.raises(InputError, match=told):
        offline.recorded_config(both)
    with pytest.raises(InputError, match=told):
        next(offline.events(both, config))
    with pytest.raises(InputError, match=told):
        offline.estimate(both, config, warn=pytest.fail)
    assert offline.recorded_config(both, "/b/c") == config
    count = len(list(offline.events(bag, config)))
    assert len(list(offline.events(both, config, namespace="/a"))) == count
    assert offline.estimate(both, config, warn=pytest.fail, namespace="/a").namespace == "/a"


def test_a_namespace_without_the_robots_is_named(bag):
    with pytest.raises(InputError, match=r"expected /fleet/robot_1/odom, .* its topics are /"):
        list(offline.events(bag, offline.recorded_config(bag), namespace="/fleet"))


def test_an_estimate_tells_what_made_it(bag):
    config = offline.recorded_config(bag)
    run = offline.estimate(bag, config, warn=pytest.fail, scenario="paper")
    assert run.provenance == runs.here("paper")


def test_run_through_reports_every_step_as_it_is_done(bag):
    from multi_robot_slam.pipeline import Pipeline

    config = offline.recorded_config(bag)
    told = []
    steps = offline.run_through(Pipeline(config), offline.events(bag, config), told.append)
    assert [step.step for step in steps] == list(range(1, len(steps) + 1))
    assert told == steps[: len(told)]
    assert len(told) > len(steps) // 2


def test_progress_ends_at_the_number_of_messages(bag):
    told = []
    config = offline.recorded_config(bag)
    offline.estimate(bag, config, warn=pytest.fail, on_progress=lambda *now: told.append(now))
    done, totals = zip(*told, strict=True)
    assert set(totals) == {len(list(offline.events(bag, config)))}
    assert list(done) == sorted(done)
    assert totals[0] // 2 < done[-1] <= totals[0]


def test_the_yardstick_is_computed_when_it_is_asked_for(bag):
    config = offline.recorded_config(bag)
    plain = offline.estimate(bag, config, warn=pytest.fail)
    asked = offline.estimate(bag, config, warn=pytest.fail, yardstick=True)
    assert not any(len(robot.yardstick.poses) for robot in plain.robots.values())
    assert all(len(robot.yardstick.poses) for robot in asked.robots.values())
