"""Ids of landmarks that were joined."""

import numpy as np
import pytest

from multi_robot_slam.smoothing.aliases import Aliases


@pytest.mark.parametrize("pairs", [[], [[1, 5]], [[1, 5], [0, 7]]])
def test_aliases_replace_ids_through_several_joins(pairs):
    aliases = Aliases().joined(np.array(pairs, int).reshape(-1, 2))
    aliases = aliases.joined(np.array([[0, 1]]))
    expected = np.array([0, 0, 2, 0 if [1, 5] in pairs else 5, 0 if [0, 7] in pairs else 7])
    assert aliases.of(np.array([0, 1, 2, 5, 7])).tolist() == expected.tolist()
    assert aliases.among(np.array([1, 2])).of(np.array([1, 5, 7])).tolist() == [0, 5, 7]


def test_ids_keep_their_shape_and_type():
    aliases = Aliases().joined(np.array([[3, 8]]))
    ids = np.array([[8, 2], [3, 9]], np.int32)
    assert aliases.of(ids).tolist() == [[3, 2], [3, 9]]
    assert aliases.of(ids).dtype == np.int32
    assert Aliases().of(ids) is ids
    assert (len(Aliases()), len(aliases)) == (0, 1)
