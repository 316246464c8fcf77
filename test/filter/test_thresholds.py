"""The default thresholds are what docs/design.md derives them from."""

import numpy as np
import pytest
from scipy.stats import chi2

from multi_robot_slam.filter.settings import FilterSettings
from sim_world import descriptors, world
from sim_world.scenario import Scenario

SETTINGS = FilterSettings()


def test_the_gate_turns_one_right_match_in_a_hundred_away():
    assert chi2.sf(SETTINGS.gate, df=3) == pytest.approx(0.01, rel=1e-3)


def test_the_descriptor_threshold_lies_between_equal_and_different_landmarks():
    scenario = Scenario()
    looks = world.build(scenario).landmarks.descriptors.astype(float)
    sigma = scenario.descriptor_noise
    for seed in range(5):
        spread = descriptors.distance_spread(looks, sigma, np.random.default_rng(seed))
        assert spread.equal.max() < SETTINGS.descriptor_gate < spread.nearest_other.min()
    assert chi2.sf(SETTINGS.descriptor_gate / (2 * sigma**2), df=128) < 1 / 20_000


def test_no_threshold_separates_landmarks_under_more_noise():
    looks = world.build(Scenario()).landmarks.descriptors.astype(float)
    spread = descriptors.distance_spread(looks, 0.014, np.random.default_rng(0))
    assert spread.equal.max() > spread.nearest_other.min()
