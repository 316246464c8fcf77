"""Threads: BLAS gets one, whoever calls."""

import numpy as np
import worlds
from threadpoolctl import ThreadpoolController, threadpool_limits

from multi_robot_slam.filter import rbpf
from multi_robot_slam.models.parallel import one_thread


def blas_threads():
    controller = ThreadpoolController().select(user_api="blas")
    return [library.num_threads for library in controller.lib_controllers]


def test_blas_has_one_thread_from_the_first_call_on():
    """Were it given back, it would be taken from another thread that is still inside."""
    with threadpool_limits(2, user_api="blas"):
        assert set(one_thread(blas_threads)()) == {1}
        assert set(blas_threads()) == {1}


def test_a_step_of_the_filter_uses_one_thread(monkeypatch):
    seen = []
    proposal = rbpf.PROPOSALS["motion"]

    def watched(*args):
        seen.extend(blas_threads())
        return proposal(*args)

    monkeypatch.setitem(rbpf.PROPOSALS, "motion", watched)
    settings = worlds.settings(particles=5)
    state = rbpf.init(worlds.START, settings)
    with threadpool_limits(2, user_api="blas"):
        rbpf.step(state, worlds.drive(0, 1)[0], settings, np.random.default_rng(0))
    assert set(seen) == {1}
