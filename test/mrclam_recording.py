"""A made-up recording in the format of UTIAS MRCLAM."""

import numpy as np

from multi_robot_slam.datasets import dead_reckoning
from multi_robot_slam.datasets.recording import Commands

START = 1_248_446_180.0
LANDMARKS = np.array([[4.0, 1.0], [4.0, -2.0], [7.0, 0.5], [9.0, -1.0]])
COMMANDS = {1: (0.1, 0.02), 2: (0.08, -0.01)}
STARTS = {1: np.zeros(3), 2: np.array([1.5, -0.3, 0.1])}
BARCODES = {1: 5, 2: 14, 3: 41, 4: 32, 5: 23, 6: 61}


def lines(rows):
    text = "".join(" \t ".join(f"{value:.6f}" for value in row) + " \n" for row in rows)
    return "# four\n# lines of\n# header\n# text\n" + text


def true_pose(robot, seconds):
    forward, yaw_rate = COMMANDS[robot]
    commands = Commands(np.array([0]), np.array([forward]), np.array([yaw_rate]))
    x, y, yaw = dead_reckoning.poses_at(commands, np.array([round(seconds * 1e9)]))[0]
    start = STARTS[robot]
    cos, sin = np.cos(start[2]), np.sin(start[2])
    return start + np.array([cos * x - sin * y, sin * x + cos * y, yaw])


def measured(robot):
    for seconds in np.arange(2.11, 28, 0.25):
        pose = true_pose(robot, seconds)
        other = 3 - robot
        subjects = dict(enumerate(LANDMARKS, start=3))
        subjects[other] = true_pose(other, seconds)[:2]
        for subject, place in subjects.items():
            dx, dy = place - pose[:2]
            bearing = (np.arctan2(dy, dx) - pose[2] + np.pi) % (2 * np.pi) - np.pi
            if abs(bearing) < 0.5:
                yield START + seconds, BARCODES[subject], np.hypot(dx, dy), bearing
        if seconds < 3:
            yield START + seconds, 99, 2.0, 0.1


def write(folder, ends=None):
    """Two robots that drive exactly as commanded past four landmarks, for 30 s.

    `ends` maps (robot, kind of log) to when that log ends instead [s].
    """
    (folder / "Barcodes.dat").write_text(lines(BARCODES.items()))
    places = [(row + 3, *place, 1e-4, 1e-4) for row, place in enumerate(LANDMARKS)]
    (folder / "Landmark_Groundtruth.dat").write_text(lines(places))
    for robot, twist in COMMANDS.items():
        times = np.arange(0, 30, 0.1)
        logs = {
            "Odometry": [(START + t, *twist) for t in times],
            "Groundtruth": [(START + t, *true_pose(robot, t)) for t in times],
            "Measurement": measured(robot),
        }
        for kind, rows in logs.items():
            end = START + (ends or {}).get((robot, kind), 60)
            kept = [row for row in rows if row[0] <= end]
            (folder / f"Robot{robot}_{kind}.dat").write_text(lines(kept))
