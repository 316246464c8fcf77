"""The filtering optimum: the yardstick of an instant."""

from dataclasses import replace

import numpy as np
import pytest

from multi_robot_slam.pipeline import refinement
from multi_robot_slam.studies import accuracy, experiment_grid, exploration, filtering_optimum


@pytest.fixture(scope="module")
def explored():
    base = accuracy.calibrated()
    explored = exploration.explore(base, experiment_grid.usual(base, 2, "informed", 4))
    alone = replace(base.filters["informed"], particles=1)
    run, pipeline = exploration.estimate(explored, alone)
    return pipeline.lineage(), run.observation_truth, run.config


def test_at_the_end_it_is_where_the_yardstick_ends(explored):
    lineage = explored[0]
    last = lineage[-1][0].step
    optimum, whole = filtering_optimum.poses(*explored, last), refinement.yardstick(*explored)
    for name, path in optimum.items():
        assert path.stamps_ns.tolist() == [whole[name].stamps_ns[-1]]
        np.testing.assert_allclose(path.poses[0], whole[name].poses[-1], atol=1e-5)


def test_what_comes_later_changes_nothing(explored):
    lineage, truth, config = explored
    whole = filtering_optimum.poses(lineage, truth, config, 50)
    begin = [(record, row) for record, row in lineage if record.step <= 100]
    for name, path in filtering_optimum.poses(begin, truth, config, 50).items():
        assert len(path.stamps_ns) == 2 < len(whole[name].stamps_ns)
        np.testing.assert_array_equal(path.poses, whole[name].poses[:2])
