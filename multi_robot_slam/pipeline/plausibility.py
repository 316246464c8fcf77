"""What cannot be true of an event, and the remedy."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from msg_defs.types import ObservationSet, PoseSample, Sightings
from multi_robot_slam.config import Plausible


class Refusal(NamedTuple):
    """Why an event is not used."""

    reason: str
    """In few words, the same for all of its kind: it is counted by them."""
    remedy: str
    """The value, and what to do."""


def refusal(event: PoseSample | ObservationSet | Sightings, limits: Plausible) -> Refusal | None:
    """What lies outside the `limits`; None where nothing does."""
    if isinstance(event, PoseSample):
        return _of_odometry(event, limits)
    if isinstance(event, Sightings):
        return _of_points(event, "implausible sightings", limits)
    return _of_points(event, "implausible observations", limits) or _of_descriptors(event, limits)


def thinned(seen: ObservationSet, limits: Plausible) -> ObservationSet:
    """At most `limits.most_observations` of them, evenly spread over the frame."""
    if len(seen.positions) <= limits.most_observations:
        return seen
    rows = limits.used(len(seen.positions))
    return replace(
        seen,
        positions=seen.positions[rows],
        covariances=seen.covariances[rows],
        descriptors=seen.descriptors[rows],
    )


def _of_odometry(sample: PoseSample, limits: Plausible) -> Refusal | None:
    distance_m = np.hypot(*sample.pose[:2])
    if distance_m <= limits.farthest_odometry_m and np.isfinite(sample.pose[2]):
        return None
    return Refusal(
        "implausible odometry",
        f"{distance_m:.3g} m from the origin, yaw {sample.pose[2]:g} rad; correct it, or raise "
        f"plausible.farthest_odometry_m = {limits.farthest_odometry_m:g}",
    )


def _of_points(seen: ObservationSet | Sightings, reason: str, limits: Plausible) -> Refusal | None:
    if not len(seen.positions):
        return None
    positions = seen.positions.astype(float)
    distances = np.sqrt(np.einsum("ij,ij->i", positions, positions))
    farthest = int(np.argmax(distances))
    if not distances[farthest] <= limits.farthest_m:
        return Refusal(
            reason,
            f"point {farthest} is {distances[farthest]:.3g} m away; leave it out, or raise "
            f"plausible.farthest_m = {limits.farthest_m:g}",
        )
    smallest, largest = _sigmas(seen.covariances.astype(float))
    least, most = int(np.argmin(smallest)), int(np.argmax(largest))
    if not smallest[least] >= limits.smallest_sigma_m:
        return Refusal(
            reason,
            f"point {least} has a standard deviation of {smallest[least]:.3g} m; publish what the "
            f"camera can do, or lower plausible.smallest_sigma_m = {limits.smallest_sigma_m:g}",
        )
    if not largest[most] <= limits.largest_sigma_m:
        return Refusal(
            reason,
            f"point {most} has a standard deviation of {largest[most]:.3g} m; leave it out, or "
            f"raise plausible.largest_sigma_m = {limits.largest_sigma_m:g}",
        )
    return None


def _sigmas(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the standard deviations in any direction, of (B, 6) covariances, without roots.

    With the eigenvalues a <= b <= c the determinant over the sum of the principal minors lies
    between a / 3 and a, the trace between c and 3 c. Both bounds are on the generous side.
    """
    xx, xy, xz, yy, yz, zz = covariances.T
    minors = xx * yy - xy * xy + (xx * zz - xz * xz) + (yy * zz - yz * yz)
    determinants = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    with np.errstate(invalid="ignore", divide="ignore"):
        smallest = np.sqrt(3 * np.maximum(determinants / minors, 0))
    return smallest, np.sqrt((xx + yy + zz) / 3)


def _of_descriptors(seen: ObservationSet, limits: Plausible) -> Refusal | None:
    if not len(seen.descriptors):
        return None
    norms = np.sqrt(np.einsum("ij,ij->i", seen.descriptors, seen.descriptors))
    worst = int(np.argmax(np.abs(norms - 1)))
    if abs(norms[worst] - 1) <= limits.descriptor_norm_error:
        return None
    return Refusal(
        "implausible descriptors",
        f"descriptor {worst} has the norm {norms[worst]:.3g}; publish unit vectors as FLOAT32, or "
        "512 times as much as UINT8",
    )
