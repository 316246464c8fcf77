"""Tiny stereo recordings in the formats of others, as folders."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

SENSOR = """{head}# General sensor definitions.
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: {mount}
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [50.0, 51.0, 31.0, 24.0] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.1, 0.01, 0.0, 0.0]
"""

BODY = Rotation.from_euler("zyx", [[0.1 * k, 0.05, -0.02 * k] for k in range(5)])
PLACES = np.array([[0.3 * k, 0.1 * k, 1.0 + 0.02 * k] for k in range(5)])
"""Where the drone truly is, ten times a second from `EUROC_NS` on."""
EUROC_NS = 1_403_715_273_262_142_976

LEFT_MOUNT = np.eye(4)
LEFT_MOUNT[:3] = [[0, 0, 1, 0.1], [-1, 0, 0, 0.05], [0, -1, 0, 0.02]]
RIGHT_MOUNT = LEFT_MOUNT.copy()
RIGHT_MOUNT[1, 3] -= 0.11
"""The cameras look straight ahead, with parallel axes."""


def stamps():
    return EUROC_NS + 100_000_000 * np.arange(5)


def images(count=5, height=48, width=64):
    """Pairs of noise, (height, width) uint8 each."""
    rng = np.random.default_rng(0)
    return rng.integers(0, 255, (count, 2, height, width), np.uint8)


def write_image(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image)


def write_euroc(folder):
    """ASL's layout; the truth ends before the last pair, and the first left image is alone."""
    root = folder / "mav0"
    for side, mount in enumerate((LEFT_MOUNT, RIGHT_MOUNT)):
        camera = root / f"cam{side}"
        listed = ["#timestamp [ns],filename"]
        for row, stamp in enumerate(stamps().tolist()):
            if (row, side) == (0, 1):
                continue
            write_image(camera / "data" / f"{stamp}.png", images()[row, side])
            listed.append(f"{stamp},{stamp}.png")
        (camera / "data.csv").write_text("\n".join(listed) + "\n")
        text = SENSOR.format(head="#Default\n", mount=mount.ravel().tolist())
        (camera / "sensor.yaml").write_text(text)
    truth = root / "state_groundtruth_estimate0"
    truth.mkdir()
    rows = ["#timestamp, p, q, v, b"]
    for stamp, place, turn in list(zip(stamps().tolist(), PLACES, BODY.as_quat(), strict=True))[:4]:
        rows.append(",".join(map(str, [stamp, *place, turn[3], *turn[:3], *np.zeros(9)])))
    (truth / "data.csv").write_text("\n".join(rows) + "\n")


def write_keyframes(folder):
    """The same as lone pairs."""
    for row, stamp in enumerate(stamps().tolist()):
        for side in (0, 1):
            write_image(folder / f"{stamp}_{side}.jpg", images()[row, side])
    for side, mount in enumerate((LEFT_MOUNT, RIGHT_MOUNT)):
        text = SENSOR.format(head="%YAML:1.0\n", mount=mount.ravel().tolist())
        (folder / f"cam{side}.yaml").write_text(text)
    rows = [
        " ".join(map(str, [f"{stamp * 1e-9:.5f}", *place, *turn]))
        for stamp, place, turn in zip(stamps().tolist(), PLACES, BODY.as_quat(), strict=True)
    ]
    (folder / "groundtruth_imu.txt").write_text("\n".join(["# t x y z q", *rows]) + "\n")


def kitti_poses():
    """(5, 3, 4): ahead 1 m a frame, turning to the right."""
    turns = Rotation.from_rotvec(np.outer(np.arange(5) * 0.1, [0, 1, 0])).as_matrix()
    places = np.array([[0.05 * k, 0.01 * k, 1.0 * k] for k in range(5)])
    return np.concatenate([turns, places[:, :, None]], axis=2)


def write_kitti(folder):
    """sequences/05 and poses/05.txt in `folder`; returns the former."""
    own = folder / "sequences" / "05"
    for row, (left, right) in enumerate(images()):
        write_image(own / "image_0" / f"{row:06d}.png", left)
        write_image(own / "image_1" / f"{row:06d}.png", right)
    lines = [f"P{n}: 50 0 32 {-5.0 * n} 0 50 24 0 0 0 1 0" for n in range(4)]
    (own / "calib.txt").write_text("\n".join(lines) + "\n")
    (own / "times.txt").write_text("".join(f"{0.1 * k:e}\n" for k in range(5)))
    (folder / "poses").mkdir()
    np.savetxt(folder / "poses" / "05.txt", kitti_poses().reshape(5, 12))
    return own


def write_excerpt(folder):
    """Frames 2 to 4 of such a sequence."""
    for row in range(2, 5):
        write_image(folder / "left" / f"{row:06d}.png", images()[row, 0])
        write_image(folder / "right" / f"{row:06d}.png", images()[row, 1])
    np.savetxt(folder / "pose_gt.txt", kitti_poses().reshape(5, 12))
