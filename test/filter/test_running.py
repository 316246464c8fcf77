"""Rejuvenation beside the filter: as if it were done at once, however slow the worker is."""

import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import worlds
from numba.core.dispatcher import Dispatcher

from multi_robot_slam.filter import rbpf, rejuvenation, running, snapshot
from multi_robot_slam.filter.existence import COUNTS, Existence
from multi_robot_slam.filter.running import ParticleFilter
from multi_robot_slam.filter.settings import ExistenceSettings, RejuvenationSettings

SECOND = 10**9


def settings(delay_s=0.0, **changes):
    rest = RejuvenationSettings(ancestors_below=0.5, delay_s=delay_s, unknowns=150)
    changes = {"particles": 60, "resample_below": 0.5, "rejuvenation": rest} | changes
    changes = {"existence": ExistenceSettings()} | changes
    return worlds.settings(proposal="informed", **changes)


def drive(seed=3, steps=40, alike=0.0, seen=5):
    """Steps one second apart."""
    return [
        [replace(frame, stamp_ns=t * SECOND) for frame in frames]
        for t, frames in enumerate(worlds.drive(seed, steps, seen=seen, alike=alike))
    ]


def content(state):
    """All that the next steps depend on, and the particles' pasts, as bytes."""
    found = [state.poses, state.log_weights, state.log_weight_sum, state.history.signatures]
    found += [*state.prior, state.covisible.together, state.scales.factors]
    evidence = state.existence.evidence
    found += [getattr(evidence, name) for name in ("ids", *COUNTS)]
    found += [*state.existence.views, state.existence.anchors, state.existence.visits]
    for m in range(state.poses.shape[2]):
        found += state.landmarks.of_particle(m)
        for record, row in state.history.lineage(m):
            found += [record.poses[:, row], record.matches[:, row]]
    return b"".join(np.ascontiguousarray(part).tobytes() for part in found)


def at_once(steps, settings, seed):
    """The slow twin: every rejuvenation is done where it begins. State and info of each step."""
    rng = np.random.default_rng(seed)
    state = rbpf.init(worlds.START, settings)
    begun_ns = None
    for frames in steps:
        info = rbpf.step(state, frames, settings, rng)
        now_ns = frames[0].stamp_ns
        counts = begun_ns is None or now_ns - begun_ns >= settings.rejuvenation.delay_s * SECOND
        yield state, counts, info
        if counts and now_ns != begun_ns:
            begun_ns = None
            if rejuvenation.is_due(state, settings.rejuvenation):
                begun_ns = now_ns
                own = rng.spawn(1)[0]
                old = snapshot.taken(state, settings, own)
                state.begin_origins()
                state = rejuvenation.rejuvenate(old, settings, own)[0] or state


@pytest.mark.parametrize("delay_s", [0.0, 1.0, 3.5])
def test_handed_over_it_is_what_it_would_be_done_at_once(delay_s):
    own, steps = settings(delay_s), drive()
    particles = ParticleFilter(worlds.START, own, np.random.default_rng(1))
    handed_over = 0
    for frames, (twin, counts, same) in zip(steps, at_once(steps, own, 1), strict=True):
        info = particles.step(frames)
        handed_over += info.rejuvenated is not None
        assert counts == (
            particles._begun is None
            or info.rejuvenated is not None
            or particles._begun.stamp_ns == frames[0].stamp_ns
        )
        if counts:
            assert content(particles.state) == content(twin)
            for moments, others in zip(info.moments, same.moments, strict=True):
                assert b"".join(map(np.ndarray.tobytes, moments)) == b"".join(
                    map(np.ndarray.tobytes, others)
                )
    assert handed_over > 3


def slow(function):
    def slowed(*arguments):
        time.sleep(0.05)
        return function(*arguments)

    return slowed


@pytest.mark.parametrize("delay_s", [0.0, 2.0])
def test_same_bytes_whether_the_worker_is_slow_fast_or_not_there(delay_s, monkeypatch):
    def run(threads, seed=5):
        own = settings(delay_s, threads=threads)
        particles = ParticleFilter(worlds.START, own, np.random.default_rng(seed))
        infos = [particles.step(frames) for frames in drive(steps=25)]
        moments = [part for info in infos for pair in info.moments for part in pair]
        return content(particles.state) + b"".join(part.tobytes() for part in moments)

    alone, beside = run(threads=1), run(threads=2)
    assert alone == beside
    monkeypatch.setattr(rejuvenation, "rejuvenate", slow(rejuvenation.rejuvenate))
    assert run(threads=2) == alone
    assert run(threads=2, seed=6) != alone


def test_until_it_counts_the_filter_goes_on_from_the_old_state(monkeypatch):
    own, steps = settings(5.0), drive()
    never = replace(own, rejuvenation=replace(own.rejuvenation, ancestors_below=0.0))
    particles = ParticleFilter(worlds.START, own, np.random.default_rng(1))
    twin = ParticleFilter(worlds.START, never, np.random.default_rng(1))
    for frames in steps:
        info, same = particles.step(frames), twin.step(frames)
        if info.rejuvenated is not None:
            break
        for (mean, covariance), (other, spread) in zip(info.moments, same.moments, strict=True):
            assert mean.tobytes() == other.tobytes()
            assert covariance.tobytes() == spread.tobytes()
    assert info.rejuvenated.groups > 0


def test_a_step_that_fails_is_not_repeated():
    own, steps = settings(3.0), drive()
    particles = ParticleFilter(worlds.START, own, np.random.default_rng(1))
    failed, groups = 0, 0
    for frames in steps:
        if particles._begun is not None and not failed:
            bad = replace(frames[0], motion=np.full(3, np.nan))
            with pytest.raises(rejuvenation.FAILURES):
                particles.step([bad])
            failed += 1
        info = particles.step(frames)
        groups += info.rejuvenated.groups if info.rejuvenated else 0
    assert failed
    assert groups


@pytest.mark.parametrize("repeated", [1, 2])
def test_where_a_step_cannot_be_repeated_the_filter_stays_as_it_was_and_it_is_told(
    repeated, monkeypatch
):
    own, steps = settings(2.0), drive()
    never = replace(own, rejuvenation=replace(own.rejuvenation, ancestors_below=0.0))
    particles = ParticleFilter(worlds.START, own, np.random.default_rng(1))
    twin = ParticleFilter(worlds.START, never, np.random.default_rng(1))
    step, told, calls = rbpf.step, [], []

    def fails_in_the_new_state(state, frames, settings, rng):
        if all(state is not own for own in (particles.state, twin.state)):
            calls.append(state)
            if sum(one is state for one in calls) == repeated:
                raise ValueError("on purpose")
        return step(state, frames, settings, rng)

    monkeypatch.setattr(rbpf, "step", fails_in_the_new_state)
    for frames in steps:
        before = particles.state
        info, same = particles.step(frames), twin.step(frames)
        assert particles.state is before
        assert info.moments[0][0].tobytes() == same.moments[0][0].tobytes()
        told += info.rejuvenated.failures if info.rejuvenated else ()
    assert told
    assert set(told) == {"a step cannot be repeated (on purpose)"}


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("name", ["absorb", "_how_many_settle", "Optimum"])
def test_whatever_fails_beside_the_filter_costs_that_rejuvenation_alone(name, threads, monkeypatch):
    def fails(*arguments, **named):
        raise np.linalg.LinAlgError("on purpose")

    own = settings(1.0, threads=threads)
    particles = ParticleFilter(worlds.START, own, np.random.default_rng(1))
    monkeypatch.setattr(rejuvenation, name, fails)
    told = []
    for t, frames in enumerate(drive(), 1):
        info = particles.step(frames)
        assert particles.state.steps == t
        told += info.rejuvenated.failures if info.rejuvenated else ()
    assert len(told) > 3
    assert set(told) == {"on purpose"}


def test_frames_that_saw_nothing_settle():
    own = settings(0.0)
    particles = ParticleFilter(worlds.START, own, np.random.default_rng(1))
    blind = drive(seed=4, steps=60, seen=0)
    for frames in blind + drive(seed=4, steps=60):
        info = particles.step(frames)
        assert not (info.rejuvenated and info.rejuvenated.failures)
    assert len(particles.state.history.settled) > 180
    assert len(particles.state.prior.ids) > 20


def test_after_close_no_thread_is_left():
    own = settings(1.0, threads=2)
    before = set(threading.enumerate())
    particles = ParticleFilter(worlds.START, own, np.random.default_rng(1))
    for frames in drive(steps=15):
        particles.step(frames)
    (worker,) = set(threading.enumerate()) - before
    particles.close()
    worker.join(timeout=100)
    assert not worker.is_alive()


@pytest.mark.parametrize("noise_at", ["measurement", "landmark"])
def test_after_warming_up_nothing_is_compiled_while_frames_settle(noise_at):
    modules = [m for name, m in sys.modules.items() if name.startswith("multi_robot_slam.")]
    kernels = [own for m in modules for own in vars(m).values() if isinstance(own, Dispatcher)]
    own = replace(settings(0.0), noise_at=noise_at)
    running.warm_up(own)
    before = [len(kernel.signatures) for kernel in kernels]
    assert sum(before) > 20
    particles = ParticleFilter(worlds.START, own, np.random.default_rng(1))
    for frames in drive():
        particles.step(frames)
    assert len(particles.state.history.settled) > 0
    after = [len(kernel.signatures) for kernel in kernels]
    names = [kernel.__name__ for kernel, a, b in zip(kernels, before, after, strict=True) if a != b]
    assert names == []


def test_evidence_of_existence_changes_nothing_in_the_filter():
    """Only what is published: the filter's bytes are the same with it and without."""
    without = replace(settings(), existence=worlds.EVERYTHING)
    states = []
    for own in (settings(), without):
        particles = ParticleFilter(worlds.START, own, np.random.default_rng(0))
        for frames in drive():
            particles.step(frames)
        states.append(particles.state)
    assert len(states[0].history.settled)
    assert len(states[0].existence.evidence.ids)
    nothing = Existence.nothing(len(worlds.START))
    assert len(states[1].existence.evidence.ids) == 0
    for state in states:
        state.existence = nothing
    assert content(states[0]) == content(states[1])
