"""Smoothing problems for the tests: drives of the filter, and a straight one that is linear."""

from dataclasses import replace

import numpy as np
import worlds

from multi_robot_slam.filter import rbpf
from multi_robot_slam.models.frames import BodySightings
from multi_robot_slam.models.symmetric import pack
from multi_robot_slam.smoothing import absorption, solve
from multi_robot_slam.smoothing.envelope import envelope_of
from multi_robot_slam.smoothing.prior import Prior
from multi_robot_slam.smoothing.problem import Problem, problem_of

GATE = 11.345


def filtered(seed=0, steps=12, robots=3, particles=8, **changes):
    """The filter's state after a drive, with double precision."""
    settings = worlds.settings(particles=particles, **changes)
    state = rbpf.init(worlds.START[:robots], settings, np.float64)
    rng = np.random.default_rng(seed)
    for frames in worlds.drive(seed, steps, robots):
        rbpf.step(state, frames, settings, rng)
    return state, settings


def remembered(state, particle=0, sighted=False):
    """Records and identities of a particle's history, and its path (P, 3)."""
    lineage = list(state.history.lineage(particle))[::-1]
    poses = np.array([record.poses[:, row] for record, row in lineage])
    records = [record for record, _ in lineage]
    if sighted:
        records = with_sightings(records, poses, state.poses.shape[0])
    return records, [record.matches[:, row] for record, row in lineage], poses


def with_sightings(records, poses, robots):
    """The records with noisy sightings: in every second step each robot sees the next one."""
    rng = np.random.default_rng(0)
    result = []
    for p, record in enumerate(records):
        if record.step % 2:
            other = (record.robot + 1) % robots
            apart = poses[p - record.robot + other, :2] - poses[p, :2]
            cos, sin = np.cos(poses[p, 2]), np.sin(poses[p, 2])
            root = rng.normal(0, 0.02, (2, 2)) + 0.02 * np.eye(2)
            R = root @ root.T + 1e-5 * np.eye(2)
            seen = np.array([[cos, sin], [-sin, cos]]) @ apart + rng.multivariate_normal([0, 0], R)
            sightings = BodySightings(np.array([other]), seen[None], R[[0, 0, 1], [0, 1, 1]][None])
            record = replace(record, sightings=sightings)
        result.append(record)
    return result


def posed(state, settings, particle=0, sighted=False):
    """The problem of a particle's history, and the particle's path (P, 3)."""
    records, identities, poses = remembered(state, particle, sighted)
    prior = Prior.exact(worlds.START[: state.poses.shape[0]])
    return problem_of(records, identities, prior, settings.motion), poses


def later(steps=18, count=18, sighted=False):
    """The problem of a drive whose first `count` records have left, and its records' poses."""
    state, settings = filtered(steps=steps)
    records, identities, poses = remembered(state, sighted=sighted)
    known = Prior.exact(worlds.START)
    whole = problem_of(records, identities, known, settings.motion)
    known = absorption.absorb(whole, solve.smooth(whole, poses), count, known)
    rest = problem_of(records[count:], identities[count:], known, settings.motion, also=known.ids)
    return rest, poses[count:]


def covariance_of(found):
    """(3 P, 3 P) of the records' poses."""
    first, last = 3 * len(found.anchors), found.poses.size
    return covariance_of_views(found)[first:last, first:last]


def covariance_of_views(found):
    """(3 (A + P) + 2 a, ...) of poses and centres."""
    known = found.poses.size + 2 * len(found.centres)
    deviations = found.factor.solve_upper(np.eye(found.factor.size))[:known]
    return deviations @ deviations.T


def with_hubs(monkeypatch, share):
    """A share of all landmarks shall be hubs, whatever is cheapest."""

    def envelope(problem):
        count = round(share * len(problem.ids))
        hubs = np.random.default_rng(0).choice(len(problem.ids), count, replace=False)
        return envelope_of(problem, np.sort(hubs))

    monkeypatch.setattr(solve, "cheapest_envelope", envelope)


def straight(seed=0, poses=6, landmarks=4):
    """A linear world: one robot whose heading is known, and its true landmarks (N, 3)."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(2, 8, (landmarks, 3))
    path = np.cumsum(np.array([1.0, 0.2]) + rng.normal(0, 0.1, (poses, 2)), axis=0)
    seen_from = np.tile(np.arange(poses), landmarks)
    truth = np.repeat(places, poses, axis=0) - np.pad(path, ((0, 0), (0, 1)))[seen_from]
    roots = rng.normal(0, 0.1, (len(truth), 3, 3)) + 0.1 * np.eye(3)
    R = roots @ roots.transpose(0, 2, 1) + 1e-3 * np.eye(3)
    noise = (np.linalg.cholesky(R) @ rng.standard_normal((len(truth), 3, 1)))[:, :, 0]
    return Problem(
        prior=start_of(np.zeros((1, 3))),
        robots=np.zeros(1 + poses, int),
        previous=np.arange(poses),
        motions=np.tile([1.0, 0.2, 0.0], (poses, 1)),
        sigmas=np.tile([0.1, 0.2, 1e-9], (poses, 1)),
        seen_from=1 + seen_from,
        starts=poses * np.arange(landmarks + 1),
        positions=truth + noise,
        information=pack(np.linalg.inv(R)),
        ids=np.arange(landmarks),
    )


def start_of(poses):
    """A problem's prior: nothing but start poses (K, 3) that are known, headings above all."""
    active = Prior.exact(poses).active(np.arange(len(poses)), np.empty(0, int))
    unit = np.eye(poses.size)
    return active._replace(whitener=1e8 * unit, information=1e16 * unit)
