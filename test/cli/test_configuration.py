"""Which of bag, scenario and single settings decides what a run is configured with."""

from dataclasses import replace

import pictures
import pytest

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from msg_defs.types import CameraMount, PoseSample
from multi_robot_slam.bags import BagWriter, absolute
from multi_robot_slam.cli import configuration, overrides
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.front_end.settings import DESCRIPTOR_GATE

RECORDED = Config(
    robots=("alice", "bob"),
    start_poses=((1.0, 2.0, 0.5), (3.0, 4.0, 0.25)),
    sightings=True,
    camera_frame="{robot}/eye",
    mount=CameraMount(up_m=0.3),
    seed=5,
    filter=FilterSettings(particles=33, gate=8.0),
)


def write_bag(folder, config, robots, namespace=""):
    """A bag with a configuration, and something from each of `robots`."""

    def named(topic):
        return topic._replace(name=absolute(topic.name, namespace))

    with BagWriter(folder) as bag:
        if config is not None:
            text = scenario_file.to_yaml(**{SECTION: config})
            bag.write(named(topics.FUSION_CONFIG), 1, wire.encode_text(text))
        for robot in robots:
            pose = wire.encode_pose(PoseSample(robot, 1, [0.0, 0.0, 0.0]), "odom", "base_link")
            bag.write(named(topics.odometry(robot)), 1, pose)
            bag.write(named(topics.observations(robot)), 1, b"")
    return folder


@pytest.fixture
def bag(tmp_path):
    return write_bag(tmp_path / "bag", RECORDED, RECORDED.robots)


@pytest.fixture
def choose(bag, tmp_path):
    """The configuration of a run of the bag: `choose(scenario's section or None, *settings)`."""

    def chosen(section=None, *words, of=bag, warn=pytest.fail):
        scenario = tmp_path / "given.yaml"
        scenario.write_text(f"multi_robot_slam: {section}")
        path = None if section is None else str(scenario)
        return configuration.of_run(configuration.Recording(of), path, overrides.parse(words), warn)

    return chosen


def test_without_a_scenario_everything_is_the_bags(choose):
    assert choose() == RECORDED


def test_what_a_scenario_leaves_out_is_the_bags_about_robots_and_a_default_about_the_filter(choose):
    config = choose("{filter: {gate: 9.0}}")
    assert (config.filter.gate, config.filter.particles) == (9.0, FilterSettings().particles)
    assert config.seed == Config().seed
    for name in ("robots", "start_poses", "sightings", "camera_frame", "mount"):
        assert getattr(config, name) == getattr(RECORDED, name)


def test_what_a_scenario_states_wins_over_the_bag(choose):
    config = choose(
        "{robots: [bob, alice], start_poses: [[9, 9, 0], [8, 8, 0]], sightings: false,"
        " mount: {up_m: 0.7}}"
    )
    assert config.robots == ("bob", "alice")
    assert config.start_poses == ((9.0, 9.0, 0.0), (8.0, 8.0, 0.0))
    assert config.sightings is False
    assert config.mount == CameraMount(up_m=0.7)


@pytest.mark.parametrize("robots", [("bob",), ("bob", "alice")])
def test_robots_that_are_stated_keep_their_own_start_poses(choose, robots):
    own = dict(zip(RECORDED.robots, RECORDED.start_poses, strict=True))
    listed = ", ".join(robots)
    told = []
    for config in (
        choose(f"{{robots: [{listed}]}}", warn=told.append),
        choose(None, f"robots=[{listed}]", warn=told.append),
    ):
        assert config.robots == robots
        assert config.start_poses == tuple(own[robot] for robot in robots)


@pytest.mark.parametrize("namespace", ["", "/fleet"])
def test_robots_that_were_recorded_and_are_not_named_are_told_in_one_warning(
    choose, tmp_path, namespace
):
    told, bag = [], tmp_path / "four"
    write_bag(bag, RECORDED, ["alice", "bob", "carol", "dave"], namespace)
    choose("{robots: [bob], start_poses: [[0, 0, 0]]}", of=bag, warn=told.append)
    assert told == [
        f"{bag} has more robots, which are not estimated: alice, carol, dave; name them in robots"
    ]


def test_mounts_of_the_bag_go_with_their_robots_until_another_mount_is_stated(choose, tmp_path):
    mounts = ((0.0, 0.1, 0.2, 0.0, 0.0, 0.0), (0.5, 0.0, 0.3, 0.0, 0.1, 0.0))
    bag = write_bag(tmp_path / "mounts", replace(RECORDED, mounts=mounts), RECORDED.robots)
    config = choose("{robots: [bob]}", of=bag, warn=str)
    assert config.mount_of(0) == CameraMount(*mounts[1])
    config = choose("{mount: {up_m: 0.7}}", of=bag)
    assert [config.mount_of(robot).up_m for robot in (0, 1)] == [0.7, 0.7]


def test_start_poses_alone_are_those_of_the_recorded_robots(choose):
    config = choose("{start_poses: [[9, 9, 0], [8, 8, 0]]}")
    assert config.robots == RECORDED.robots
    assert config.start_poses[1] == (8.0, 8.0, 0.0)
    with pytest.raises(InputError, match="1 poses for 2 robots"):
        choose("{start_poses: [[9, 9, 0]]}")


def test_single_settings_win_over_the_scenario_and_leave_the_rest(choose):
    config = choose("{filter: {gate: 9.0, particles: 4}}", "filter.particles=7", "seed=3")
    assert (config.filter.gate, config.filter.particles, config.seed) == (9.0, 7, 3)
    config = choose(None, "filter.particles=7")
    assert (config.filter.gate, config.filter.particles, config.seed) == (8.0, 7, 5)


@pytest.mark.parametrize("section", ["{robots: [alice, dave]}", "{robots: [dave]}"])
def test_a_stated_robot_without_a_start_pose_is_refused(choose, section):
    with pytest.raises(InputError, match=r"none of dave, its robots are alice, bob; state start_p"):
        choose(section)


def test_a_stated_robot_that_was_not_recorded_is_refused(choose):
    with pytest.raises(
        InputError, match=r"dave was not recorded: .* has no /dave/odom and no /dave/stereo"
    ):
        choose("{robots: [alice, dave], start_poses: [[0, 0, 0], [0, 0, 0]]}")


def test_a_robot_of_the_bags_own_configuration_that_sent_nothing_is_told(choose, tmp_path):
    told = []
    bag = write_bag(tmp_path / "silent", RECORDED, ["alice"])
    assert choose(of=bag, warn=told.append) == RECORDED
    (line,) = told
    assert "bob was not recorded" in line
    assert "/bob/odom" in line


@pytest.mark.parametrize(
    ("namespace", "topic"), [(None, "/fusion/config"), ("other", "/other/fusion/config")]
)
def test_a_missing_configuration_is_told_by_its_topic(tmp_path, namespace, topic):
    bare = write_bag(tmp_path / "bare", None, ["robot_1"])
    with pytest.raises(InputError, match=f"no configuration on {topic}, its topics"):
        configuration.of_run(configuration.Recording(bare, namespace), None, {}, pytest.fail)


def test_a_bag_without_configuration_needs_a_scenario(choose, tmp_path):
    bare = write_bag(tmp_path / "bare", None, ["robot_1"])
    with pytest.raises(InputError, match="name one with --scenario"):
        choose(None, "filter.particles=7", of=bare)
    assert choose("{filter: {particles: 4}}", of=bare).filter.particles == 4


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["filter.particels=9"], "no setting 'filter.particels'; similar are filter.particles"),
        (["particles=9"], "similar are filter.particles"),
        (["xyzzy=9"], "config.yaml of a run has all"),
        (["filter.particles"], "give name=value"),
        (["robots=[a"], "not valid YAML"),
        (["seed=1", "seed=2"], "given twice"),
        (["filter={gate: 1}", "filter.particles=2"], None),
        (["seed=1", "filter=3", "filter.particles=2"], "set as a whole"),
    ],
)
def test_settings_that_cannot_be_meant_are_refused(words, told):
    if told is None:
        assert overrides.parse(words) == {"filter": {"gate": 1, "particles": 2}}
        return
    with pytest.raises(InputError) as caught:
        overrides.parse(words)
    assert told in str(caught.value)


def test_a_value_out_of_range_names_its_setting(choose):
    with pytest.raises(InputError, match=r"--set: filter\.particles = 0"):
        choose(None, "filter.particles=0")


def test_names_are_completed():
    assert overrides.completions("filter.parti") == ["filter.particles="]


def test_the_scenario_for_cameras_is_what_pictures_get_without_one(tmp_path):
    shipped = scenario_file.from_file(Config, scenario_file.find_scenario("cameras"), SECTION)
    assert shipped.filter.descriptor_gate == DESCRIPTOR_GATE != FilterSettings().descriptor_gate
    mine = tmp_path / "mine.yaml"
    mine.write_text(f"{SECTION}: {{robots: [robot_1], filter: {{particles: 9}}}}")
    pictures.record(tmp_path / "bag", with_config=False)
    recording = configuration.Recording(tmp_path / "bag")
    config = configuration.of_run(recording, str(mine), {}, pytest.fail)
    assert config.filter == replace(shipped.filter, particles=9)
    stated = {"filter": {"descriptor_gate": 0.5}}
    config = configuration.of_run(recording, str(mine), stated, pytest.fail)
    assert config.filter.descriptor_gate == 0.5
    pictures.record(tmp_path / "known", replace(pictures.team(), filter=FilterSettings(gate=7.0)))
    recording = configuration.Recording(tmp_path / "known")
    assert configuration.of_run(recording, None, {}, pytest.fail).filter.gate == 7.0
