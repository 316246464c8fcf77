"""Gradient and information matrix of the cost at one path, landmarks at their best."""

from typing import NamedTuple

import numpy as np

from multi_robot_slam.smoothing.cost import odometry_residuals
from multi_robot_slam.smoothing.envelope import Envelope
from multi_robot_slam.smoothing.kernels import information, links
from multi_robot_slam.smoothing.problem import Problem, with_map


class Links(NamedTuple):
    """What ties two poses each, whitened: L of them, odometry first, then sightings."""

    ends: np.ndarray
    """(L, 2) int64: the two poses; the first is -1 for a start pose."""
    residuals: np.ndarray
    """(L, 3) float64."""
    jacobians: np.ndarray
    """(L, 3, 6) float64: derivatives of the residuals by the two poses."""


class System(NamedTuple):
    """The information matrix H, and where each unknown is in it."""

    rows: np.ndarray
    """(P + 1,) int64: row of each pose's x; the last stands for MAP and has none."""
    hubs: np.ndarray
    """(N,) int64: row of each landmark's x, -1 if it is eliminated."""
    origins: np.ndarray
    """(3 U,) int64: row r, column c is element origins[r] + c."""
    elements: np.ndarray
    """(`Envelope.size`,) float64."""


def gradient_of(
    problem: Problem, poses: np.ndarray, landmarks: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """(3 P,) of the cost, landmarks at their best."""
    gradient = np.zeros(poses.size)
    links.add_link_gradient(_links(problem, poses, weights), gradient)
    observations = problem.observations(weights)
    links.add_observation_gradient(observations, with_map(poses), landmarks, gradient)
    return gradient


def information_of(
    problem: Problem,
    poses: np.ndarray,
    landmarks: np.ndarray,
    weights: np.ndarray,
    envelope: Envelope,
) -> np.ndarray:
    """The elements of H in its envelope, lower triangle."""
    rows = 3 * envelope.place
    hubs = np.full(len(problem.ids), -1)
    hubs[envelope.hubs] = rows[len(poses) :]
    of_poses = np.append(rows[: len(poses)], -1)
    system = System(of_poses, hubs, envelope.origins, np.zeros(envelope.size))
    information.add_links(_links(problem, poses, weights), system)
    observations = problem.observations(weights)
    information.add_observations(observations, with_map(poses), landmarks, system)
    return system.elements


def _links(problem: Problem, poses: np.ndarray, weights: np.ndarray) -> Links:
    """Odometry and sightings, along one path."""
    count = len(poses)
    previous = np.column_stack([problem.previous, np.arange(count)])
    sightings = problem.sightings(weights)
    ends = np.concatenate([previous, np.column_stack([sightings.seen_from, sightings.seen])])
    residuals, jacobians = np.zeros((len(ends), 3)), np.zeros((len(ends), 3, 6))
    residuals[:count] = odometry_residuals(problem, poses)
    before = problem.poses_before(poses)
    links.odometry_jacobians(before, problem.sigmas, poses, jacobians[:count])
    links.link_sightings(sightings, poses, residuals[count:], jacobians[count:])
    return Links(ends, residuals, jacobians)
