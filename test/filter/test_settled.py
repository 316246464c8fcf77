"""Settled frames: paths, and how often landmarks were seen."""

import numpy as np
import pytest

from multi_robot_slam.filter.settled import SeenLandmarks, Settled
from multi_robot_slam.models.frames import Record
from multi_robot_slam.smoothing.aliases import Aliases


def record(robot, stamp_ns, landmarks):
    return Record(
        robot=robot,
        stamp_ns=stamp_ns,
        step=stamp_ns,
        motion=np.zeros(3),
        positions=np.zeros((len(landmarks), 3)),
        covariances=np.zeros((len(landmarks), 6)),
        poses=np.zeros((3, 4)),
        matches=np.tile(np.array(landmarks, np.int32)[:, None], (1, 4)),
        new_ids=np.zeros(len(landmarks), np.int32),
        parents=np.arange(4, dtype=np.int32),
    )


def identities_of(records):
    return [own.matches[:, 0] for own in records]


RECORDS = [record(0, 1, [5, 3]), record(2, 2, [3]), record(0, 3, []), record(2, 4, [5, 9])]
POSES = np.arange(12.0).reshape(4, 3)


@pytest.mark.parametrize("parts", [[4], [1, 3], [2, 0, 2], [1, 1, 1, 1]])
def test_frames_settle_in_any_parts_with_the_same_result(parts):
    settled, first = Settled(), 0
    for count in parts:
        own = slice(first, first + count)
        settled = settled.also(RECORDS[own], POSES[own], identities_of(RECORDS[own]), Aliases())
        first += count
    assert len(settled) == 4
    stamps, poses = settled.path(2)
    np.testing.assert_array_equal(stamps, [2, 4])
    np.testing.assert_array_equal(poses, POSES[[1, 3]])
    assert len(settled.path(1)[0]) == 0
    counts, robots = settled.seen.of_ids(np.array([9, 3, 4, 5]))
    np.testing.assert_array_equal(counts, [1, 2, 0, 2])
    np.testing.assert_array_equal(robots, [0b100, 0b101, 0, 0b101])
    for frame, pose, own in zip(settled.frames, POSES, RECORDS, strict=True):
        np.testing.assert_array_equal(frame.poses[:, 0], pose)
        np.testing.assert_array_equal(frame.matches, own.matches[:, :1])


def test_joined_landmarks_count_together():
    joined = Aliases().joined(np.array([[3, 5]]))
    settled = Settled().also(RECORDS[:2], POSES[:2], identities_of(RECORDS[:2]), Aliases())
    later = [joined.of(own) for own in identities_of(RECORDS[2:])]
    settled = settled.also(RECORDS[2:], POSES[2:], later, joined)
    counts, robots = settled.seen.of_ids(np.array([3, 5, 9]))
    np.testing.assert_array_equal(counts, [4, 0, 1])
    np.testing.assert_array_equal(robots, [0b101, 0, 0b100])
    np.testing.assert_array_equal(settled.frames[0].matches, [[3], [3]])


def test_frames_are_kept_only_where_wanted():
    settled = Settled(keeps_frames=False)
    settled = settled.also(RECORDS, POSES, identities_of(RECORDS), Aliases())
    assert settled.frames == ()
    assert len(settled) == 4


def test_nothing_was_seen_at_first():
    counts, robots = SeenLandmarks.nothing().of_ids(np.array([1, 2]))
    assert not counts.any()
    assert not robots.any()
