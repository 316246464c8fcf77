"""Refined runs and the yardstick, on simulated explorations."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
import recordings
from scipy.stats import chi2

from msg_defs.types import StereoCamera
from multi_robot_slam import runs
from multi_robot_slam.filter.settings import NO_REJUVENATION
from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.pipeline import offline, refinement
from multi_robot_slam.pipeline.pipeline import Pipeline
from sim_world.scenario import Scenario
from sim_world.simulator import Simulation

SCENARIO = Scenario(robots=2, movements=90, observations=8, camera=StereoCamera(sigma_rc_px=1.0))


USUAL = {"particles": 20, "learn_noise": False}


class Exploration:
    """A simulated run, filtered."""

    def __init__(self, seed=0, **of_filter):
        self.simulation = Simulation(SCENARIO, seed)
        self.config = recordings.configuration(self.simulation, **USUAL | of_filter)
        self.pipeline = Pipeline(self.config)
        self.truth, steps = {}, []
        for instant in self.simulation.steps():
            for robot in instant:
                seen = robot.observation_truth
                self.truth[seen.robot, seen.stamp_ns] = seen.landmarks.astype(int)
                for event in (robot.odometry, robot.observations):
                    steps += self.pipeline.handle(event)
        steps += self.pipeline.finish()
        self.run = runs.assemble(
            self.config,
            runs.Recorded(odometry={}, observation_truth=self.truth),
            steps,
            self.pipeline.trajectories(),
            self.pipeline.landmark_map(),
            {},
        )

    def matched(self, identify):
        """Lineage and map if the particle had identified each observation as `identify` says.

        `identify(true landmarks (B,), index of the frame)` -> (B,) ids; each is shown as its true
        landmark, id modulo 10,000.
        """
        lineage, ids = [], []
        for index, (record, row) in enumerate(self.pipeline.lineage()):
            rows = self.truth[self.config.robots[record.robot], record.stamp_ns]
            ids.append(np.asarray(identify(rows, index), np.int32))
            taken = replace(record, matches=ids[-1][:, None], poses=record.poses[:, [row]])
            lineage.append((taken, 0))
        ids = np.unique(np.concatenate(ids))
        shown = self.simulation.landmarks
        values = {field.name: getattr(shown, field.name)[ids % 10_000] for field in fields(shown)}
        return lineage, replace(shown, **values | {"ids": ids.astype(np.uint32)})

    def perfect(self):
        return self.matched(lambda rows, index: rows)


@pytest.fixture(scope="module")
def explored():
    return Exploration()


def assert_same_paths(paths, others, atol):
    assert paths.keys() == others.keys()
    for name, path in paths.items():
        np.testing.assert_array_equal(path.stamps_ns, others[name].stamps_ns)
        np.testing.assert_allclose(path.poses[:, :2], others[name].poses[:, :2], atol=atol)
        np.testing.assert_allclose(
            np.exp(1j * path.poses[:, 2]), np.exp(1j * others[name].poses[:, 2]), atol=atol
        )


def deaf(config, gate=1e6):
    """With a gate so wide that nothing is an outlier."""
    return replace(config, filter=replace(config.filter, gate=gate, robust_above=gate))


def test_yardstick_does_not_depend_on_the_particle(explored):
    expected = refinement.yardstick(explored.pipeline.lineage(), explored.truth, explored.config)
    other = Exploration(particles=1, proposal="motion", rejuvenation=NO_REJUVENATION)
    found = refinement.yardstick(other.pipeline.lineage(), explored.truth, explored.config)
    assert_same_paths(found, expected, atol=1e-4)


def test_yardstick_needs_the_truth_of_every_frame(explored):
    lineage = explored.pipeline.lineage()
    key, rows = next(iter(explored.truth.items()))
    missing = {k: v for k, v in explored.truth.items() if k != key}
    for truth in ({}, missing, missing | {key: rows[:-1]}):
        assert refinement.yardstick(lineage, truth, explored.config) is None
    assert refinement.yardstick([], {}, explored.config) is None


def test_yardstick_is_plain_least_squares_until_there_are_gross_errors(explored):
    lineage, exact = explored.pipeline.lineage(), explored.truth
    expected = refinement.yardstick(lineage, exact, deaf(explored.config))
    found = refinement.yardstick(lineage, exact, explored.config)
    assert_same_paths(found, expected, atol=0)
    record, row = lineage[60]
    wrong = record.positions.copy()
    wrong[0] += [2, 0, -1]
    spoiled = [*lineage[:60], (replace(record, positions=wrong), row), *lineage[61:]]
    resisting = refinement.yardstick(spoiled, exact, explored.config)
    assert_same_paths(resisting, expected, atol=0.02)
    fooled = refinement.yardstick(spoiled, exact, deaf(explored.config))
    with pytest.raises(AssertionError):
        assert_same_paths(fooled, expected, atol=0.02)


def test_factors_of_the_odometry_are_found(explored):
    lineage, landmarks = explored.perfect()
    told = [(replace(r, motion=r.motion * [1.1, 1.1, 0.9]), row) for r, row in lineage]
    config = deaf(explored.config)
    noise = replace(config.filter.motion, scale_sigma=0.2)
    doubting = replace(config, filter=replace(config.filter, motion=noise))
    expected = refinement.refine(lineage, landmarks, doubting).paths
    by_refining = refinement.refine(told, landmarks, doubting).paths
    by_yardstick = refinement.yardstick(told, explored.truth, doubting)
    for found in (by_refining, by_yardstick):
        assert_same_paths(found, expected, atol=5e-3)
    with pytest.raises(AssertionError):
        assert_same_paths(refinement.refine(told, landmarks, config).paths, expected, atol=5e-3)


def test_paths_and_noise_that_is_learnt_agree(explored):
    lineage, _ = explored.perfect()
    config = explored.config
    config = replace(config, filter=replace(config.filter, learn_noise=True))
    records = [record for record, _ in lineage]
    poses = np.array([record.poses[:, row] for record, row in lineage])
    seen = [record.matches[:, row] for record, row in lineage]
    nothing = refinement.Learnt.nothing(config, len(config.robots))
    problem, smoothed, known = refinement._smooth(
        records, seen, poses, nothing, 11.345, config, range(len(config.robots))
    )
    motions = np.array([record.motion for record in records])
    again = refinement._learnt(known, problem, smoothed, motions, config)
    np.testing.assert_allclose(again.noise.used, known.noise.used, rtol=0.01)
    assert (known.noise.factors != 1).all()
    np.testing.assert_array_equal(known.noise.used, known.noise.factors.clip(min=1))
    np.testing.assert_allclose(known.noise.used[:, 1], 1, atol=0.1)


def test_perfect_associations_are_refined_to_the_yardstick(explored):
    lineage, landmarks = explored.perfect()
    refined = refinement.refine(lineage, landmarks, deaf(explored.config))
    expected = refinement.yardstick(lineage, explored.truth, explored.config)
    assert_same_paths(refined.paths, expected, atol=1e-4)
    np.testing.assert_array_equal(refined.landmarks.ids, landmarks.ids)


def test_split_landmarks_are_joined(explored):
    """Every landmark gets a new id in the second half of the run: the refinement undoes it."""
    half = len(explored.pipeline.lineage()) // 2
    lineage, landmarks = explored.matched(lambda rows, index: rows + 10_000 * (index > half))
    refined = refinement.refine(lineage, landmarks, explored.config)
    whole = refinement.refine(*explored.perfect(), explored.config)
    assert len(landmarks.ids) > len(whole.landmarks.ids)
    sources = refined.landmarks.ids % 10_000
    assert sorted(sources) == sorted(whole.landmarks.ids)
    assert refined.landmarks.observations.sum() == whole.landmarks.observations.sum()
    assert_same_paths(refined.paths, whole.paths, atol=1e-3)


def test_landmarks_that_look_different_stay_apart(explored):
    half = len(explored.pipeline.lineage()) // 2
    lineage, landmarks = explored.matched(lambda rows, index: rows + 10_000 * (index > half))
    unlike = landmarks.descriptors.copy()
    unlike[landmarks.ids >= 10_000] *= -1
    landmarks = replace(landmarks, descriptors=unlike)
    refined = refinement.refine(lineage, landmarks, explored.config)
    np.testing.assert_array_equal(refined.landmarks.ids, landmarks.ids)


def test_landmarks_seen_in_one_frame_are_two(explored):
    """All look alike and the gate lets everything pass: only what no frame saw twice may join."""
    lineage, landmarks = explored.perfect()
    same = replace(landmarks, descriptors=np.zeros_like(landmarks.descriptors))
    refined = refinement.refine(lineage, same, deaf(explored.config, gate=1e9))
    most = max(len(record.positions) for record, _ in lineage)
    assert most <= len(refined.landmarks.ids) < len(same.ids)
    config = deaf(explored.config, gate=1e9)
    config = replace(config, filter=replace(config.filter, exclusive=False))
    assert len(refinement.refine(lineage, same, config).landmarks.ids) == 1


def test_refined_map_has_the_errors_it_claims(explored):
    """NEES of the marginal covariances, over runs: its mean is 3."""
    values = []
    for seed in range(3):
        each = explored if seed == 0 else Exploration(seed)
        lineage, landmarks = each.perfect()
        refined = refinement.refine(lineage, landmarks, each.config).landmarks
        errors = refined.positions.astype(float) - landmarks.positions
        covariances = unpack(refined.covariances)
        whitened = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
        values += np.sum(errors * whitened, axis=1).tolist()
    # Landmarks of one run share its path, so their number is a tenth at the most.
    effective = len(values) / 10
    low, high = chi2.ppf([0.001, 0.999], 3 * effective) / effective
    assert low < np.mean(values) < high


def test_nothing_is_refined_to_nothing(explored):
    pipeline = Pipeline(explored.config)
    refined = refinement.refine([], pipeline.landmark_map(), explored.config)
    assert refined.paths == {}
    assert len(refined.landmarks.ids) == 0


def test_completed_run_has_all_paths(explored):
    run = refinement.complete(
        explored.run, explored.pipeline, with_refined=True, with_yardstick=True
    )
    for robot in run.robots.values():
        for path in (robot.mean, robot.refined, robot.yardstick):
            np.testing.assert_array_equal(path.stamps_ns, robot.path.stamps_ns)
    assert set(run.refined_landmarks.ids) <= set(run.landmarks.ids)


def test_run_too_long_to_smooth_is_told(explored, monkeypatch):
    monkeypatch.setattr(refinement, "MAX_FRAMES", 10)
    run = refinement.complete(
        explored.run, explored.pipeline, with_refined=True, with_yardstick=True
    )
    assert run.refined_landmarks is None
    assert len(run.robots["robot_1"].yardstick.stamps_ns) == 0
    assert "10 are the most" in run.warnings[-1]


def test_run_that_cannot_be_smoothed_goes_on_unrefined(explored, monkeypatch):
    lineage = explored.pipeline.lineage()
    record, row = lineage[20]
    lineage[20] = replace(record, positions=np.full_like(record.positions, np.nan)), row
    monkeypatch.setattr(explored.pipeline, "lineage", lambda: lineage)
    run = refinement.complete(
        explored.run, explored.pipeline, with_refined=True, with_yardstick=True
    )
    assert run.refined_landmarks is None
    yardstick, refined = run.warnings[-2:]
    assert yardstick.startswith("no yardstick: smoothing ")
    assert refined.startswith("not refined: smoothing ")
    robot = run.robots["robot_1"]
    assert len(robot.refined.poses) == len(robot.yardstick.poses) == 0 < len(robot.mean.poses)


def test_command_refines(command, tmp_path):
    recordings.record(tmp_path / "bag", SCENARIO, seed=1)
    assert command("run", tmp_path / "bag", "--out", tmp_path / "out", "--refine")[0] == 0
    assert command("evaluate", tmp_path / "out")[0] == 0
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    for key in ("mean_path_rmse_m", "refined_path_rmse_m", "batch_path_rmse_m"):
        assert 0 < result[key] < result["odometry_path_rmse_m"]
    assert result["refined_map_rmse_m"] > 0
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"refined_robot_1.tum", "refined_robot_2.tum", "refined_map.csv"} <= written


def test_live_run_has_the_yardstick_of_its_bag(tmp_path):
    _, config = recordings.record(tmp_path / "bag", is_live=True)
    live = offline.load(tmp_path / "bag")
    again = offline.estimate(tmp_path / "bag", config, warn=lambda text: None, yardstick=True)
    paths = {name: robot.yardstick for name, robot in live.robots.items()}
    assert_same_paths(paths, {n: robot.yardstick for n, robot in again.robots.items()}, atol=1e-4)
