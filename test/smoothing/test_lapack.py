"""The whitening of a covariance."""

import numpy as np
import pytest

from multi_robot_slam.smoothing.lapack import whitener


@pytest.mark.parametrize("size", [0, 1, 7, 150])
def test_whitener_is_the_root_of_the_inverse(size):
    root = np.random.default_rng(0).normal(size=(size, size + 3))
    covariance = root @ root.T
    before = covariance.copy()
    W, information = whitener(covariance)
    np.testing.assert_array_equal(covariance, before)
    np.testing.assert_array_equal(W, np.tril(W))
    np.testing.assert_array_equal(information, information.T)
    np.testing.assert_allclose(W @ covariance @ W.T, np.eye(size), atol=1e-9)
    np.testing.assert_allclose(information @ covariance, np.eye(size), atol=1e-8)


def test_matrix_without_inverse_says_so():
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        whitener(np.array([[1.0, 2.0], [2.0, 1.0]]))
