"""Gradient and information matrix of the cost, landmarks at their best."""

from typing import NamedTuple

import numpy as np

from multi_robot_slam.smoothing.cost import odometry_residuals, prior_residuals
from multi_robot_slam.smoothing.envelope import Envelope
from multi_robot_slam.smoothing.kernels import information, links
from multi_robot_slam.smoothing.problem import Problem


class Links(NamedTuple):
    """What ties two poses each, whitened: L of them, odometry first, then sightings."""

    ends: np.ndarray
    """(L, 2) int64: the two poses."""
    residuals: np.ndarray
    """(L, 3) float64."""
    jacobians: np.ndarray
    """(L, 3, 6) float64: derivatives of the residuals by the two poses."""


class System(NamedTuple):
    """The information matrix H, and where each unknown is in it."""

    rows: np.ndarray
    """(V,) int64: row of each view's x."""
    widths: np.ndarray
    """(V,) int64: number of its rows."""
    hubs: np.ndarray
    """(N,) int64: row of each landmark's x, -1 if it is eliminated."""
    origins: np.ndarray
    """(rows,) int64: row r, column c is element origins[r] + c heights[r]."""
    heights: np.ndarray
    elements: np.ndarray
    """(`Envelope.size`,) float64."""


def gradient_of(
    problem: Problem, views: np.ndarray, landmarks: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """(3 (A + P) + 2 a,) of the cost by poses and centres, landmarks at their best."""
    columns = problem.columns
    gradient = np.zeros(columns[-1])
    links.add_link_gradient(_links(problem, views, weights), gradient)
    observations = problem.observations(weights)
    links.add_observation_gradient(observations, views, columns, landmarks, gradient)
    known = prior_residuals(problem, views)
    gradient[problem.prior_columns] += problem.prior.information @ known
    return gradient


def information_of(
    problem: Problem,
    views: np.ndarray,
    landmarks: np.ndarray,
    weights: np.ndarray,
    envelope: Envelope,
) -> np.ndarray:
    """The elements of H in its envelope, lower triangle."""
    hubs = np.full(len(problem.ids), -1)
    hubs[envelope.hubs] = envelope.rows_of[len(views) :]
    origins, heights = envelope.addresses()
    system = System(
        rows=envelope.rows_of[: len(views)],
        widths=np.diff(problem.columns),
        hubs=hubs,
        origins=origins,
        heights=heights,
        elements=np.zeros(envelope.size),
    )
    information.add_links(_links(problem, views, weights), system)
    information.add_observations(problem.observations(weights), views, landmarks, system)
    rows = envelope.places[problem.prior_columns]
    information.add_prior(problem.prior.information, rows, system)
    return system.elements


def _links(problem: Problem, views: np.ndarray, weights: np.ndarray) -> Links:
    """Odometry and sightings, along one path."""
    count, first = len(problem.previous), len(problem.anchors)
    own = first + np.arange(count)
    previous = np.column_stack([problem.previous, own])
    sightings = problem.sightings(weights)
    ends = np.concatenate([previous, np.column_stack([sightings.seen_from, sightings.seen])])
    residuals, jacobians = np.zeros((len(ends), 3)), np.zeros((len(ends), 3, 6))
    residuals[:count] = odometry_residuals(problem, views)
    before = views[problem.previous]
    links.odometry_jacobians(before, problem.sigmas, views[own], jacobians[:count])
    links.link_sightings(sightings, views, residuals[count:], jacobians[count:])
    return Links(ends, residuals, jacobians)
