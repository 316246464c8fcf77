"""One robot's frame on its way through the kernels: candidates in, matches and a weight out."""

from typing import NamedTuple

import numpy as np

from multi_robot_slam.filter import association, kernels
from multi_robot_slam.filter.association import Candidates
from multi_robot_slam.filter.kernels import Matches, Observed
from multi_robot_slam.filter.known_distance import at_known
from multi_robot_slam.filter.landmarks import Landmarks
from multi_robot_slam.filter.pieces import MAP
from multi_robot_slam.filter.settings import FilterSettings, threads
from multi_robot_slam.filter.sightings import Sighted
from multi_robot_slam.filter.state import State
from multi_robot_slam.models.frames import RobotFrame


class FrameInfo(NamedTuple):
    """What each particle made of one robot's frame, before resampling."""

    matches: np.ndarray
    """(B, M) int32: id of the landmark that was updated or created."""
    mahalanobis_sq: np.ndarray
    """(B, M): D (18)."""
    log_likelihood: np.ndarray
    """(M,) float64: sum of the logarithms of (16) and of the sightings' factors."""
    new_ids: np.ndarray
    """(B,) int32: id of the landmark that each observation would create."""
    candidates: Candidates
    candidate_ids: np.ndarray
    """(C,) int32: id of each candidate."""
    sighted: Sighted

    def descriptor_distances(self, matches: np.ndarray) -> np.ndarray:
        """E (19) of B `matches` (ids), (B,) float32; NaN where a match was no candidate."""
        observation = np.repeat(np.arange(len(matches)), np.diff(self.candidates.starts))
        chosen = self.candidate_ids == matches[observation]
        result = np.full(len(matches), np.nan, np.float32)
        result[observation[chosen]] = self.candidates.distances[chosen]
        return result


class Matching(NamedTuple):
    """The arrays the kernels read and write for one frame, in the dtype of the planes."""

    frame: RobotFrame
    """As given, with the covariances that count."""
    observed: Observed
    candidates: Candidates
    touched: np.ndarray
    """Columns of the landmarks among the candidates, each once."""
    new_columns: np.ndarray
    """(B,) the column each observation may create."""
    matches: Matches
    piece: int
    """Of the robot."""
    unmapped: np.ndarray | None
    """(T, 9, M) the planes of the `touched` before, where the frame must not change the map."""


def begin(
    state: State, frame: RobotFrame, settings: FilterSettings, pose_margin: np.ndarray
) -> Matching:
    """Find the candidates (18), (19) of a frame and bring them up to date.

    `pose_margin` (2,): how far each pose may still move [m] and turn [rad] before the gate is
    tried.
    """
    landmarks, (v, noise) = state.landmarks, (frame.positions, frame.covariances)
    piece = int(state.pieces.of_robots[frame.robot])
    count, dtype = len(v), landmarks.planes.dtype
    near = np.empty(0, int)
    if count:
        poses = state.poses[frame.robot]
        box = association.field_of_search(poses, v, noise, settings.gate, pose_margin)
        near = landmarks.near(box)
        near = near[landmarks.pieces[near] == piece]
    candidates = association.find_candidates(
        frame.descriptors, landmarks.descriptors[near], near, settings.descriptor_gate
    )
    touched = association.landmarks_among(candidates.columns)
    landmarks.bring_up_to_date(touched, threads(settings))
    if settings.noise_at == "landmark":
        frame = at_known(frame, landmarks, candidates, touched, state.poses[frame.robot])
    shape = (count, settings.particles)
    matches = Matches(np.empty(shape, np.int32), np.empty(shape, dtype), np.empty(shape, dtype))
    observed = Observed(v.astype(dtype), frame.covariances.astype(dtype))
    new_columns = landmarks.reserve(count)
    is_changed = settings.mapping or piece != MAP
    unmapped = None if is_changed else landmarks.planes[touched]
    return Matching(frame, observed, candidates, touched, new_columns, matches, piece, unmapped)


def finish(
    landmarks: Landmarks,
    settings: FilterSettings,
    matching: Matching,
    sighted: Sighted,
) -> FrameInfo:
    """Keep the landmarks that were created, and weigh (16).

    Without `mapping` none is kept, and those that were updated are as before.
    """
    frame, _, candidates, touched, new_columns, matches, piece, unmapped = matching
    new_ids = landmarks.ids[new_columns]
    ids, candidate_ids = kernels.name(
        matches.columns, candidates.columns, new_columns, landmarks.ids
    )
    created = kernels.complete_new(landmarks.planes, new_columns, matches.columns)
    if unmapped is not None:
        landmarks.planes[touched] = unmapped
        created[:] = 0
    landmarks.bound(touched, settings.gate)
    landmarks.bound(new_columns[created > 0], settings.gate)
    landmarks.commit(new_columns, created, frame.descriptors, piece)
    log_likelihood = kernels.log_likelihood(matches.mahalanobis_sq, matches.determinants)
    return FrameInfo(
        ids,
        matches.mahalanobis_sq,
        log_likelihood + sighted.log_factor,
        new_ids,
        candidates,
        candidate_ids,
        sighted,
    )


def as_seen(poses: np.ndarray, dtype: type | np.dtype) -> np.ndarray:
    """(4, M) cos yaw, sin yaw, x, y of `poses` (3, M), as kernels take them."""
    seen = np.empty((4, poses.shape[1]), dtype)
    yaw = poses[2].astype(dtype)
    np.cos(yaw, out=seen[0])
    np.sin(yaw, out=seen[1])
    seen[2:] = poses[:2]
    return seen
