"""Wire formats: nothing is lost, nothing damaged gets in, ROS reads and writes the same bytes."""

import functools
import re
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from msg_defs import topics, wire
from msg_defs.errors import InputError
from msg_defs.types import (
    CameraInfo,
    Estimate,
    FrameRecord,
    Image,
    LandmarkMap,
    ObservationSet,
    ObservationTruth,
    PoseSample,
    Sightings,
    StepRecord,
    Tied,
    Trajectory,
    Verdict,
    Walls,
)
from msg_defs.wire import cdr, clouds, messages
from msg_defs.wire import poses as poses_wire

ROBOT = "robot_2"
STAMP = 1_700_000_000_123_456_789
STORE = get_typestore(Stores.ROS2_JAZZY)
CLOUD = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
CAMERA = topics.camera_frame(ROBOT)
SIX = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])

finite = st.floats(allow_nan=False, allow_infinity=False, width=64)
finite32 = st.floats(allow_nan=False, allow_infinity=False, width=32)
stamps = st.integers(0, 2**31 * 10**9 - 1)
poses = hnp.arrays(float, 3, elements=st.floats(-3.1, 3.1))


def array32(*shape):
    return hnp.arrays(np.float32, shape, elements=finite32)


def numbers32(*shape):
    return np.random.default_rng(1).normal(size=shape).astype(np.float32)


def covariances(count):
    """(count, 6) float32, positive definite."""
    root = np.random.default_rng(2).normal(size=(count, 3, 3))
    return (root @ root.swapaxes(1, 2) + 0.1 * np.eye(3))[:, *SIX].astype(np.float32)


def observations(count=4):
    positions = numbers32(count, 3)
    positions[:, 2] = np.abs(positions[:, 2]) + 0.1
    return ObservationSet(ROBOT, STAMP, positions, covariances(count), numbers32(count, 128))


def sightings(count=2):
    seen = observations(count)
    others = np.arange(count, dtype=np.uint32) * 3
    return Sightings(ROBOT, STAMP, others, seen.positions, seen.covariances)


def landmark_map(count=5):
    rows = np.arange(count, dtype=np.uint32)
    return LandmarkMap(
        2**32 - 1 - rows,
        numbers32(count, 3),
        covariances(count),
        rows,
        rows + 7,
        numbers32(count, 128),
    )


def pose_sample():
    covariance = np.array([[0.2, 0.1, 0.0], [0.1, 0.3, -0.05], [0.0, -0.05, 0.02]])
    return PoseSample(ROBOT, STAMP, np.array([1.5, -2.5, 0.75]), np.array([0.4, -0.1]), covariance)


def trajectory(count=4):
    generator = np.random.default_rng(3)
    return Trajectory(STAMP + np.arange(count) ** 2, generator.uniform(-3, 3, (count, 3)))


def walls():
    return Walls(np.random.default_rng(4).normal(size=(3, 4)), 2.5)


def frame_record(robot=ROBOT, count=3):
    return FrameRecord(
        robot,
        np.arange(count, dtype=np.int64) * 10**12,
        np.arange(count) % 2 == 0,
        np.arange(count) % 3 == 0,
        np.where(np.arange(count) % 2, numbers32(count), np.nan).astype(np.float32),
        numbers32(count),
        np.arange(2),
        numbers32(2),
        np.array([False, True]),
    )


def step_record():
    frames = (frame_record("robot_1", 0), frame_record())
    verdicts = (
        Verdict("robot_1", "consistent"),
        Verdict(ROBOT, "start wrong", "off by 0.3 m", "measure it", {"offset [m]": 0.1 + 0.2}),
    )
    return StepRecord(STAMP, 7, frames, (), 0.1 + 0.2, True, 1 / 3, verdicts=verdicts)


def ties():
    counts = st.integers(0, 1000)
    robots = st.sampled_from([(ROBOT,), (ROBOT, "robot_1")])
    pose = hnp.arrays(np.float64, 3, elements=finite)
    return st.builds(Tied, robots, st.booleans(), pose, counts, counts, counts, finite)


def encode_odometry(sample):
    return wire.encode_pose(sample, topics.odom_frame(ROBOT), topics.base_frame(ROBOT))


def of_robot(decode):
    return functools.partial(decode, robot=ROBOT)


def picture(encoding="bgr8", height=6, width=8):
    kind = wire.ENCODINGS[encoding]
    shape = (height, width, kind.channels) if kind.channels > 1 else (height, width)
    pixels = np.random.default_rng(9).integers(0, np.iinfo(kind.dtype).max, shape, kind.dtype)
    return Image(STAMP, CAMERA, encoding, pixels)


def camera_info():
    intrinsics = np.array([[458.6, 0, 367.2], [0, 457.3, 248.4], [0, 0, 1]])
    projection = np.array([[435.2, 0, 367.5, -47.9], [0, 435.2, 252.2, 0], [0, 0, 1, 0]])
    distortion = np.array([-0.28, 0.07, 2e-4, 1.8e-5, 0])
    rotation = Rotation.from_rotvec([0.01, -0.02, 0.003]).as_matrix()
    return CameraInfo(
        STAMP, CAMERA, 752, 480, "plumb_bob", distortion, intrinsics, rotation, projection
    )


def called(decode):
    return functools.partial(decode, what="left image of robot_2")


statuses = (wire.Status("fusion", {"a": "1", "ü": ""}, wire.WARN, "slow", ROBOT),)

KINDS = {
    "pose": (encode_odometry(pose_sample()), of_robot(wire.decode_pose)),
    "observations": (
        wire.encode_observations(observations()),
        of_robot(wire.decode_observations),
    ),
    "sightings": (wire.encode_sightings(sightings()), of_robot(wire.decode_sightings)),
    "observation_truth": (
        wire.encode_observation_truth(ObservationTruth(ROBOT, STAMP, np.arange(3, dtype="u4"))),
        of_robot(wire.decode_observation_truth),
    ),
    "map": (wire.encode_map(landmark_map(), STAMP), wire.decode_map),
    "pieces": (
        wire.encode_pieces(landmark_map(), np.full(len(landmark_map().ids), 2), STAMP),
        wire.decode_pieces,
    ),
    "walls": (wire.encode_walls(walls(), STAMP), wire.decode_walls),
    "estimate": (
        wire.encode_estimate(Estimate(ROBOT, STAMP, np.array([1.0, 2, 3]), np.eye(3))),
        of_robot(wire.decode_estimate),
    ),
    "path": (wire.encode_path(trajectory(), STAMP), of_robot(wire.decode_path)),
    "particles": (wire.encode_particles(np.eye(3), STAMP), of_robot(wire.decode_particles)),
    "step": (wire.encode_step(step_record()), wire.decode_step),
    "diagnostics": (wire.encode_diagnostics(STAMP, statuses), wire.decode_diagnostics),
    "text": (wire.encode_text("seed: 1\n"), wire.decode_text),
    "image": (wire.encode_image(picture()), called(wire.decode_image)),
    "jpeg": (wire.encode_compressed(picture()), called(wire.decode_compressed)),
    "png": (wire.encode_compressed(picture("mono16"), "png"), called(wire.decode_compressed)),
    "camera_info": (wire.encode_camera_info(camera_info()), called(wire.decode_camera_info)),
}


def assert_identical(read, written):
    """Equal in type, shape and every bit, but for NaN."""
    assert type(read) is type(written)
    if is_dataclass(written):
        for field in fields(written):
            assert_identical(getattr(read, field.name), getattr(written, field.name))
    elif isinstance(written, tuple):
        assert len(read) == len(written)
        for pair in zip(read, written, strict=True):
            assert_identical(*pair)
    elif isinstance(written, np.ndarray):
        assert read.dtype == written.dtype
        np.testing.assert_array_equal(read, written, strict=True)
        if written.dtype.kind == "f":
            signs = (np.signbit(values[~np.isnan(written)]) for values in (read, written))
            np.testing.assert_array_equal(*signs)
    else:
        assert read == written


def changed(data, type_name, change):
    """The message with `change(message)` done to it."""
    message = STORE.deserialize_cdr(data, type_name)
    change(message)
    return bytes(STORE.serialize_cdr(message, type_name))


class TestRoundTrip:
    @given(st.data(), st.integers(0, 5), stamps)
    def test_observations(self, data, count, stamp):
        positions = data.draw(array32(count, 3))
        positions[:, 2] = np.abs(positions[:, 2]) + np.float32(1e-30)
        descriptors = data.draw(array32(count, 128))
        written = ObservationSet(ROBOT, stamp, positions, covariances(count), descriptors)
        read = wire.decode_observations(wire.encode_observations(written), ROBOT)
        assert_identical(read, written)

    @given(st.integers(0, 5), stamps)
    def test_sightings(self, count, stamp):
        written = replace(sightings(count), stamp_ns=stamp)
        read = wire.decode_sightings(wire.encode_sightings(written), ROBOT)
        assert_identical(read, written)

    @given(hnp.arrays(np.uint32, st.integers(0, 5)), stamps)
    def test_observation_truth(self, landmarks, stamp):
        written = ObservationTruth(ROBOT, stamp, landmarks)
        read = wire.decode_observation_truth(wire.encode_observation_truth(written), ROBOT)
        assert_identical(read, written)

    @given(st.data(), st.integers(0, 5))
    def test_map(self, data, count):
        whole = hnp.arrays(np.uint32, count)
        written = LandmarkMap(
            data.draw(hnp.arrays(np.uint32, count, unique=True)),
            data.draw(array32(count, 3)),
            np.where(np.arange(count)[:, None] % 2, covariances(count), np.float32(0)),
            data.draw(whole),
            data.draw(whole),
            data.draw(array32(count, 128)),
        )
        assert_identical(wire.decode_map(wire.encode_map(written, 5)), written)
        pieces = data.draw(hnp.arrays(np.int32, count, elements=st.integers(1, 32)))
        read, numbers = wire.decode_pieces(wire.encode_pieces(written, pieces, 5))
        assert_identical(read, written)
        assert numbers.tolist() == pieces.tolist()

    @given(poses, hnp.arrays(float, 2, elements=finite), stamps)
    def test_pose(self, pose, twist, stamp):
        written = PoseSample(ROBOT, stamp, pose, twist, pose_sample().covariance)
        read = wire.decode_pose(encode_odometry(written), ROBOT)
        np.testing.assert_allclose(read.pose[2], pose[2], rtol=4e-16, atol=4e-16)
        assert_identical(replace(read, pose=pose), replace(written, pose=pose))
        np.testing.assert_array_equal(read.pose[:2], pose[:2])

    @given(poses, stamps)
    def test_estimate(self, pose, stamp):
        written = Estimate(ROBOT, stamp, pose, pose_sample().covariance)
        read = wire.decode_estimate(wire.encode_estimate(written), ROBOT)
        np.testing.assert_allclose(read.pose, pose, rtol=4e-16, atol=4e-16)
        assert_identical(replace(read, pose=pose), written)
        both = replace(written, pose=pose + 1, mean=pose)
        assert wire.encode_mean(both) == wire.encode_estimate(written)

    @given(hnp.arrays(float, st.tuples(st.integers(0, 5), st.just(3)), elements=st.floats(-3, 3)))
    def test_path_and_particles(self, poses):
        written = Trajectory(STAMP + np.arange(len(poses)), poses)
        read = wire.decode_path(wire.encode_path(written, STAMP), ROBOT)
        assert_identical(read.stamps_ns, written.stamps_ns)
        particles = wire.decode_particles(wire.encode_particles(poses, STAMP), ROBOT)
        for found in (read.poses, particles):
            np.testing.assert_allclose(found, poses, rtol=4e-16, atol=4e-16, strict=True)

    @given(
        hnp.arrays(float, st.tuples(st.integers(0, 4), st.just(4)), elements=finite),
        st.floats(0, 1e3, exclude_min=True),
    )
    def test_walls(self, segments, height_m):
        written = Walls(segments, height_m)
        assert_identical(wire.decode_walls(wire.encode_walls(written, STAMP)), written)

    @given(st.data(), st.integers(0, 4), finite, finite, st.booleans())
    def test_step(self, data, count, effective, duration, resampled):
        any32 = hnp.arrays(np.float32, count, elements=st.floats(width=32))
        flags = hnp.arrays(bool, count)
        frame = FrameRecord(
            ROBOT,
            data.draw(hnp.arrays(np.int64, count)),
            data.draw(flags),
            data.draw(flags),
            data.draw(any32),
            data.draw(any32),
            others=data.draw(hnp.arrays(np.int64, 2)),
            other_mahalanobis=data.draw(hnp.arrays(np.float32, 2)),
            is_other_rejected=data.draw(hnp.arrays(bool, 2)),
        )
        numbers = data.draw(st.dictionaries(st.sampled_from(["a [m]", "found: b"]), finite))
        level = data.draw(st.sampled_from(list(wire.LEVELS)))
        verdict = Verdict(ROBOT, level, "cause: ü", "", numbers)
        written = StepRecord(
            *(STAMP, 3, (frame, frame_record("robot_1")), (), effective, resampled, duration),
            verdicts=(verdict,),
            tied=data.draw(st.none() | ties()),
        )
        read = wire.decode_step(wire.encode_step(written))
        assert_identical(read, written)

    def test_a_level_that_is_none_is_refused(self):
        def invented(message):
            for pair in message.status[1].values:
                pair.value = "fine" if pair.key == "level" else pair.value

        data = changed(wire.encode_step(step_record()), topics.STEPS.type, invented)
        with pytest.raises(InputError, match="level = 'fine'; it must be one of consistent, "):
            wire.decode_step(data)

    def test_nobody_takes_landmarks_of_pieces_for_those_of_the_map(self):
        with pytest.raises(InputError, match="frame"):
            wire.decode_map(KINDS["pieces"][0])

    def test_a_verdict_is_the_level_of_its_robots_status(self):
        _, statuses = wire.decode_diagnostics(wire.encode_step(step_record()))
        assert [status.level for status in statuses] == [wire.OK, wire.OK, wire.ERROR]
        assert statuses[2].message == "start wrong"

    def test_step_of_an_older_bag_has_no_sightings_no_rejuvenation_and_no_verdicts(self):
        def without_them(message):
            later = {"others", "other_mahalanobis", "is_other_rejected", "sighted", "rejuvenated"}
            later |= {"level", "cause", "remedy"}
            for status in message.status:
                status.values = [pair for pair in status.values if pair.key not in later]

        written = replace(step_record(), rejuvenated=0.5)
        read = wire.decode_step(changed(wire.encode_step(written), topics.STEPS.type, without_them))
        assert read.rejuvenated is None
        assert not read.verdicts
        assert [len(frame.others) for frame in read.frames] == [0, 0]
        for ours, theirs in zip(read.frames, written.frames, strict=True):
            assert_identical(ours.landmarks, theirs.landmarks)

    @pytest.mark.parametrize(
        ("key", "value"),
        [
            ("tied: pose [m, m, rad]", "1 2"),
            ("tied: is in map", "2"),
            ("tied: places that agree", "x"),
        ],
    )
    def test_a_tie_that_is_none_is_refused(self, key, value):
        def broken(message):
            for pair in message.status[0].values:
                pair.value = value if pair.key == key else pair.value

        tied = Tied((ROBOT,), True, np.zeros(3), 8, 6, 2, 0.5)
        data = wire.encode_step(replace(step_record(), tied=tied))
        with pytest.raises(InputError, match=re.escape(f"{key} = '{value}'")):
            wire.decode_step(changed(data, topics.STEPS.type, broken))

    def test_step_leaves_out_the_estimates(self):
        estimate = Estimate(ROBOT, STAMP, np.zeros(3), np.eye(3))
        assert (
            wire.decode_step(
                wire.encode_step(replace(step_record(), estimates=(estimate,)))
            ).estimates
            == ()
        )

    def test_diagnostics(self):
        assert wire.decode_diagnostics(wire.encode_diagnostics(STAMP, statuses)) == (
            STAMP,
            statuses,
        )

    @given(st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"])))
    def test_text(self, text):
        assert wire.decode_text(wire.encode_text(text)) == text


class TestFrames:
    def test_the_wire_is_the_optical_frame(self):
        """A point up and to the right of the axis has x > 0 and y < 0 in REP-103's frame."""
        written = replace(observations(1), positions=np.float32([[1, 2, 3]]))
        message = STORE.deserialize_cdr(wire.encode_observations(written), CLOUD)
        assert message.data[:12].view("<f4").tolist() == [1, -2, 3]
        assert message.header.frame_id == "robot_2/camera_left_optical"

    def test_the_covariance_turns_with_the_points(self):
        """The Mahalanobis distance of a point is the same in both frames."""
        written = observations(1)
        message = STORE.deserialize_cdr(wire.encode_observations(written), CLOUD)
        optical = message.data[12:36].view("<f4")
        flip = np.diag([1, -1, 1])
        full = np.zeros((3, 3))
        full[SIX] = full[SIX[::-1]] = written.covariances[0]
        np.testing.assert_array_equal((flip @ full @ flip)[SIX], optical)

    @given(st.floats(-3, 3), st.floats(-1, 1), st.floats(-1, 1), st.sampled_from([1, -1]))
    def test_yaw_of_a_tilted_robot(self, yaw, pitch, roll, sign):
        def tilt(message):
            rotation = Rotation.from_euler("ZYX", [yaw, pitch, roll])
            message.pose.pose.orientation = STORE.types["geometry_msgs/msg/Quaternion"](
                *(sign * rotation.as_quat())
            )

        data = changed(KINDS["pose"][0], ODOMETRY, tilt)
        assert wire.decode_pose(data, ROBOT).pose[2] == pytest.approx(yaw, abs=1e-12)

    def test_ground_truth_is_a_pose_in_map(self):
        data = wire.encode_pose(pose_sample(), topics.MAP_FRAME, topics.base_frame(ROBOT))
        np.testing.assert_allclose(wire.decode_pose(data, ROBOT).pose, pose_sample().pose)

    def test_transform(self):
        data = wire.encode_transform(STAMP, "map", "robot_2/odom", np.array([1.0, 2.0, np.pi / 2]))
        (transform,) = STORE.deserialize_cdr(data, "tf2_msgs/msg/TFMessage").transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", "robot_2/odom")
        q, t = transform.transform.rotation, transform.transform.translation
        ahead = Rotation.from_quat([q.x, q.y, q.z, q.w]).apply([1, 0, 0])
        moved = np.add(ahead, [t.x, t.y, t.z])
        np.testing.assert_allclose(moved, [1, 3, 0], atol=1e-15)

    @pytest.mark.parametrize("names", [("a", "b"), ("a/base_link", "röbot/odom"), ("", "abcd")])
    def test_transforms_are_read_by_two_other_decoders(self, names):
        """One is rosbags', one mcap-ros2's."""
        given = [
            wire.Transform(*names, (1, 2, 3, 0, 0, 0, 1)),
            wire.Transform(*names[::-1], (7,) * 7),
        ]
        data, kind = wire.encode_transforms(STAMP, given), topics.TF_STATIC.type
        text, _ = wire.message_schema(kind)
        schema = Schema(1, text.encode(), "ros2msg", kind)
        dynamic = DecoderFactory().decoder_for("cdr", schema)
        for message in (STORE.deserialize_cdr(data, kind), dynamic(data)):
            for transform, (frame_id, child, pose) in zip(message.transforms, given, strict=True):
                assert (transform.header.frame_id, transform.child_frame_id) == (frame_id, child)
                stamp = transform.header.stamp
                assert stamp.sec * 10**9 + stamp.nanosec == STAMP
                q, t = transform.transform.rotation, transform.transform.translation
                assert (t.x, t.y, t.z, q.x, q.y, q.z, q.w) == pose


class TestMarkers:
    def markers(self, landmarks, paths):
        data = wire.encode_markers(landmarks, paths, STAMP)
        return STORE.deserialize_cdr(data, topics.MAP_MARKERS.type).markers

    def test_axes_end_on_the_3_sigma_ellipsoid(self):
        landmarks = landmark_map(2)
        lines = next(m for m in self.markers(landmarks, {}) if m.ns == "3 sigma")
        ends = np.array([(p.x, p.y, p.z) for p in lines.points]).reshape(2, 6, 3)
        for centre, six, tips in zip(landmarks.positions, landmarks.covariances, ends, strict=True):
            full = np.zeros((3, 3))
            full[SIX] = full[SIX[::-1]] = six
            offsets = tips - centre
            squared = np.einsum("ij,jk,ik->i", offsets, np.linalg.inv(full), offsets)
            np.testing.assert_allclose(squared, 9, rtol=1e-4)
            axes = offsets[::2]
            np.testing.assert_allclose(axes @ axes.T, np.diag((axes**2).sum(1)), atol=1e-5)

    def test_one_line_and_colour_a_robot(self):
        paths = {"robot_1": trajectory(), "robot_2": trajectory(1), "robot_3": trajectory()}
        markers = self.markers(landmark_map(1), paths)
        assert markers[0].action == messages.Marker.DELETEALL
        lines = [m for m in markers if m.type == messages.Marker.LINE_STRIP]
        assert [m.ns for m in lines] == ["path of robot_1", "path of robot_3"]
        assert [(p.x, p.y, p.z) for p in lines[0].points] == [
            (x, y, 0) for x, y, _ in trajectory().poses
        ]
        assert lines[0].color != lines[1].color

    def test_few_markers_however_many_landmarks(self):
        assert len(self.markers(landmark_map(300), {})) == len(self.markers(landmark_map(1), {}))


def arranged(written, order, gap=0, byte_order="<", rows=1, row_gap=0, descriptor="f4"):
    """The observations as a cloud of another maker."""
    kinds = {"x": "f4", "y": "f4", "z": "f4", "covariance": "6f4", "intensity": "f8"}
    kinds["descriptor"] = f"128{descriptor}"
    formats = [np.dtype(kinds[name]).newbyteorder(byte_order) for name in order]
    offsets = np.cumsum([gap] + [f.itemsize + gap for f in formats])
    dtype = np.dtype(
        {"names": order, "formats": formats, "offsets": offsets[:-1], "itemsize": offsets[-1]}
    )
    points = np.zeros(len(written.positions), dtype)
    points["x"], points["y"], points["z"] = (written.positions * [1, -1, 1]).T
    points["covariance"] = written.covariances * [1, -1, 1, 1, -1, 1]
    points["descriptor"] = written.descriptors * (512 if descriptor == "u1" else 1)
    used = dtype.itemsize * len(points) // rows
    data = np.full((rows, used + row_gap), 0xFF, np.uint8)
    data[:, :used] = points.view(np.uint8).reshape(rows, used)
    codes = {"f4": 7, "f8": 8, "u1": 2}
    described = [
        messages.PointField(
            name, int(offset), codes[dtype[name].base.str[1:]], dtype[name].shape or 1
        )
        for name, offset in zip(order, offsets, strict=False)
    ]
    for field in described:
        field.count = int(np.prod(field.count))
    header = messages.Header(messages.Time(*divmod(STAMP, 10**9)), CAMERA)
    cloud = messages.PointCloud2(
        header,
        rows,
        len(points) // rows,
        described,
        byte_order == ">",
        dtype.itemsize,
        used + row_gap,
        data.ravel(),
        True,
    )
    return bytes(STORE.serialize_cdr(cloud, CLOUD))


ALIEN_ORDER = ["descriptor", "intensity", "z", "covariance", "x", "y"]


class TestClouds:
    @pytest.mark.parametrize(
        "arrangement",
        [
            {},
            {"gap": 3},
            {"byte_order": ">"},
            {"rows": 2},
            {"rows": 2, "row_gap": 5, "gap": 1, "byte_order": ">"},
        ],
        ids=str,
    )
    def test_any_legal_arrangement(self, arrangement):
        written = observations(4)
        data = arranged(written, ALIEN_ORDER, **arrangement)
        assert_identical(wire.decode_observations(data, ROBOT), written)

    def test_descriptors_as_bytes(self):
        descriptors = (np.arange(4 * 128).reshape(4, 128) % 256 / 512).astype(np.float32)
        written = replace(observations(4), descriptors=descriptors)
        data = arranged(written, ALIEN_ORDER, descriptor="u1")
        assert_identical(wire.decode_observations(data, ROBOT), written)

    @pytest.mark.parametrize(
        ("change", "complaint"),
        [
            (lambda m: m.fields.pop(3), "no field 'covariance'"),
            (lambda m: setattr(m.fields[0], "datatype", 8), "'x' has datatype 8 x 1"),
            (lambda m: setattr(m.fields[4], "count", 64), "'descriptor' has datatype 7 x 64"),
            (lambda m: setattr(m.fields[4], "offset", 40), "ends at byte 552"),
            (lambda m: setattr(m.fields[4], "name", "x"), "name each once"),
            (lambda m: setattr(m, "width", 5), "width 5"),
            (lambda m: setattr(m, "height", 2), "height 2"),
            (lambda m: setattr(m, "point_step", 0), "point_step 0"),
            (lambda m: setattr(m, "row_step", 0), "row_step 0"),
            (lambda m: setattr(m, "data", m.data[:-1]), "bytes of data"),
            (lambda m: setattr(m.header, "frame_id", "robot_1/camera_left_optical"), "frame_id"),
            (lambda m: setattr(m.header.stamp, "nanosec", 10**9), "nanosec"),
        ],
    )
    def test_what_contradicts_itself_is_refused(self, change, complaint):
        data = changed(KINDS["observations"][0], CLOUD, change)
        with pytest.raises(InputError, match=complaint):
            wire.decode_observations(data, ROBOT)

    @pytest.mark.parametrize(
        ("field", "index", "value", "complaint"),
        [
            ("positions", (2, 0), np.nan, r"x\[2\] = nan"),
            ("positions", (2, 1), np.inf, r"y\[2\] = -inf"),
            ("positions", (2, 2), -0.25, r"depth z = -0.25 m of point 2 is not in front"),
            ("positions", (2, 2), 0, "depth z = 0 m"),
            ("covariances", (2, 0), -1, "of point 2 is not positive definite"),
            ("covariances", (2, slice(None)), 0, "of point 2 is not positive definite"),
            ("covariances", (2, 1), 1e9, "of point 2 is not positive definite"),
            ("covariances", (2, 5), 1e-9, "of point 2 is not positive definite"),
            ("covariances", (2, 3), np.nan, r"covariance\[2\] = nan"),
            ("descriptors", (2, 100), -np.inf, r"descriptor\[2\] = -inf"),
        ],
    )
    def test_numbers_without_meaning_are_refused(self, field, index, value, complaint):
        written = observations()
        getattr(written, field)[index] = value
        with pytest.raises(InputError, match=f"^observations of robot_2: .*{complaint}.*; "):
            wire.decode_observations(wire.encode_observations(written), ROBOT)

    def test_definite_means_positive_eigenvalues(self):
        six = np.random.default_rng(5).normal(size=(500, 6)).astype(np.float32)
        six[:, [0, 3, 5]] += np.float32(1.5)
        full = six.astype(float)[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
        definite = (np.linalg.eigvalsh(full) > 0).all(axis=1)
        assert 50 < definite.sum() < 450
        for covariance, is_definite in zip(six, definite, strict=True):
            written = replace(observations(1), covariances=covariance[None])
            data = wire.encode_observations(written)
            if is_definite:
                wire.decode_observations(data, ROBOT)
            else:
                with pytest.raises(InputError, match="not positive definite"):
                    wire.decode_observations(data, ROBOT)

    def test_landmark_ids_are_unique(self):
        written = landmark_map(3)
        written.ids[2] = written.ids[0]
        with pytest.raises(InputError, match="id 4294967295 occurs twice"):
            wire.decode_map(wire.encode_map(written, STAMP))


class TestPoses:
    @pytest.mark.parametrize(
        ("change", "complaint"),
        [
            (lambda m: setattr(m.pose.pose.orientation, "w", 0.0), "norm"),
            (lambda m: setattr(m.pose.pose.orientation, "x", np.nan), "norm nan"),
            (lambda m: setattr(m.pose.pose.orientation, "x", 1e300), "norm 1e"),
            (lambda m: setattr(m.pose.pose.position, "y", np.inf), "y = inf"),
            (lambda m: setattr(m.twist.twist.linear, "x", np.nan), "twist"),
            (lambda m: setattr(m.pose, "covariance", -np.eye(6).ravel()), "semidefinite"),
            (lambda m: setattr(m.pose, "covariance", np.triu(np.ones((6, 6))).ravel()), "symm"),
            (lambda m: setattr(m.pose, "covariance", np.full(36, np.nan)), "nan"),
            (lambda m: setattr(m.pose, "covariance", np.arange(36) * 5e306), "symmetric"),
            (lambda m: setattr(m.header, "frame_id", "robot_1/odom"), "frame_id"),
            (lambda m: setattr(m, "child_frame_id", "camera"), "child_frame_id"),
            (lambda m: setattr(m.header.stamp, "nanosec", 2**32 - 1), "nanosec"),
        ],
    )
    def test_what_is_no_pose_is_refused(self, change, complaint):
        data = changed(KINDS["pose"][0], ODOMETRY, change)
        with pytest.raises(InputError, match=f"^odometry of robot_2: .*{complaint}"):
            wire.decode_pose(data, ROBOT)

    def test_a_path_that_goes_back_in_time_is_refused(self):
        path = trajectory()
        backwards = Trajectory(path.stamps_ns[::-1], path.poses)
        with pytest.raises(InputError, match="time goes back after pose 0"):
            wire.decode_path(wire.encode_path(backwards, STAMP), ROBOT)


class TestSteps:
    @pytest.mark.parametrize(
        ("change", "complaint"),
        [
            (lambda m: m.status.clear(), "no entry for the step"),
            (lambda m: m.status[0].values.clear(), "no value 'step'"),
            (lambda m: setattr(m.status[0].values[0], "value", "x"), "step = 'x' is no number"),
            (lambda m: setattr(m.status[0].values[2], "value", "2"), "resampled = '2'"),
            (lambda m: setattr(m.status[2].values[0], "value", "4"), "3 landmarks of 4"),
            (lambda m: setattr(m.status[2].values[4], "value", "1 2 9e9"), "landmarks = '1 2 9e9'"),
            (lambda m: setattr(m.status[2].values[4], "value", "1 2 " + "9" * 30), "landmarks"),
            (lambda m: setattr(m.status[2].values[5], "value", "1 0 2"), "is_new = '1 0 2'"),
            (lambda m: setattr(m.status[1], "level", 4), "level = 4"),
        ],
    )
    def test_what_is_no_step_is_refused(self, change, complaint):
        data = changed(KINDS["step"][0], topics.STEPS.type, change)
        with pytest.raises(InputError, match=re.escape(complaint)):
            wire.decode_step(data)

    def test_counts_are_there_to_be_read(self):
        _, (step, _, frame) = wire.decode_diagnostics(wire.encode_step(step_record()))
        assert step.message == "step 7"
        assert [frame.values[k] for k in ("observed", "new", "matched", "rejected")] == list("3211")


class TestGarbage:
    @pytest.mark.parametrize("kind", KINDS)
    def test_every_truncation_is_refused_in_one_line(self, kind):
        data, decode = KINDS[kind]
        for size in {*range(min(len(data), 200)), len(data) // 2, len(data) - 4}:
            with pytest.raises(InputError) as caught:
                decode(data[:size])
            assert "\n" not in str(caught.value)

    @pytest.mark.parametrize("kind", KINDS)
    def test_the_message_of_another_type_never_crashes(self, kind):
        for data, _ in KINDS.values():
            decode_or_refuse(KINDS[kind][1], data)

    @pytest.mark.parametrize("kind", KINDS)
    @hypothesis_settings(max_examples=60)
    @given(st.lists(st.tuples(st.integers(0, 2000), st.binary(min_size=1, max_size=8)), min_size=1))
    def test_mutated_bytes_never_crash(self, kind, patches):
        data, decode = KINDS[kind]
        mutated = bytearray(data)
        for position, patch in patches:
            position %= len(data)
            mutated[position : position + len(patch)] = patch
        decode_or_refuse(decode, bytes(mutated))

    @pytest.mark.parametrize("kind", KINDS)
    @hypothesis_settings(max_examples=20)
    @given(st.binary(max_size=64))
    def test_random_bytes_never_crash(self, kind, data):
        decode_or_refuse(KINDS[kind][1], b"\0\1\0\0" + data)


def decode_or_refuse(decode, data):
    """Anything but an `InputError` of one line is a failure."""
    problem = ""
    try:
        decode(data)
    except InputError as error:
        problem = str(error)
    assert "\n" not in problem


class TestRos:
    """The same bytes as ROS's own serialisation."""

    @pytest.fixture
    def serialization(self):
        return pytest.importorskip("rclpy.serialization")

    ALL = (
        (topics.odometry(ROBOT), KINDS["pose"][0]),
        (topics.observations(ROBOT), KINDS["observations"][0]),
        (topics.observation_truth(ROBOT), KINDS["observation_truth"][0]),
        (topics.MAP_LANDMARKS, KINDS["map"][0]),
        (topics.GROUND_TRUTH_WALLS, KINDS["walls"][0]),
        (topics.pose(ROBOT), KINDS["estimate"][0]),
        (topics.path(ROBOT), KINDS["path"][0]),
        (topics.particles(ROBOT), KINDS["particles"][0]),
        (topics.STEPS, KINDS["step"][0]),
        (topics.DIAGNOSTICS, KINDS["diagnostics"][0]),
        (topics.WORLD_CONFIG, KINDS["text"][0]),
        (topics.image(ROBOT, "left"), KINDS["image"][0]),
        (topics.compressed_image(ROBOT, "left"), KINDS["png"][0]),
        (topics.camera_info(ROBOT, "left"), KINDS["camera_info"][0]),
        (topics.MAP_MARKERS, wire.encode_markers(landmark_map(), {ROBOT: trajectory()}, STAMP)),
    )

    @pytest.mark.parametrize(("topic", "data"), ALL, ids=[topic.name for topic, _ in ALL])
    def test_ros_reads_and_writes_every_kind(self, serialization, topic, data):
        message = serialization.deserialize_message(data, wire.message_class(topic.type))
        again = serialization.serialize_message(message)
        read, written = (STORE.deserialize_cdr(bytes(d), topic.type) for d in (again, data))
        assert repr(read) == repr(written)

    def test_ros_sees_the_right_values(self, serialization):
        sample = pose_sample()
        odometry = serialization.deserialize_message(KINDS["pose"][0], wire.message_class(ODOMETRY))
        assert odometry.header.stamp.sec * 10**9 + odometry.header.stamp.nanosec == STAMP
        assert odometry.child_frame_id == "robot_2/base_link"
        assert (odometry.pose.pose.position.x, odometry.pose.pose.position.y) == (1.5, -2.5)
        assert odometry.pose.pose.orientation.z == np.sin(sample.pose[2] / 2)
        assert odometry.pose.covariance.reshape(6, 6)[0, 1] == sample.covariance[0, 1]
        assert odometry.pose.covariance.reshape(6, 6)[5, 5] == sample.covariance[2, 2]
        assert odometry.twist.twist.angular.z == -0.1

        cloud = serialization.deserialize_message(
            KINDS["observations"][0], wire.message_class(CLOUD)
        )
        assert [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields] == [
            ("x", 0, 7, 1),
            ("y", 4, 7, 1),
            ("z", 8, 7, 1),
            ("covariance", 12, 7, 6),
            ("descriptor", 36, 7, 128),
        ]
        points = np.frombuffer(cloud.data, "<f4").reshape(4, -1)
        np.testing.assert_array_equal(points[:, 36 // 4 :], observations().descriptors)

    def test_we_read_what_ros_made(self, serialization):
        message = wire.message_class(ODOMETRY)()
        message.header.frame_id, message.child_frame_id = "robot_2/odom", "robot_2/base_link"
        message.header.stamp.sec, message.header.stamp.nanosec = 5, 6
        message.pose.pose.position.x = 1.25
        message.pose.covariance[35] = 0.5
        message.twist.twist.linear.x = 0.75
        read = wire.decode_pose(bytes(serialization.serialize_message(message)), ROBOT)
        assert read.stamp_ns == 5_000_000_006
        assert (read.pose.tolist(), read.twist.tolist()) == ([1.25, 0, 0], [0.75, 0])
        assert read.covariance.tolist() == [[0, 0, 0], [0, 0, 0], [0, 0, 0.5]]

    def test_we_read_clouds_of_other_makers(self, serialization):
        written = observations(4)
        cloud_type = wire.message_class(CLOUD)
        alien = arranged(written, ALIEN_ORDER, gap=3, rows=2, row_gap=5)
        message = serialization.deserialize_message(alien, cloud_type)
        data = bytes(serialization.serialize_message(message))
        assert_identical(wire.decode_observations(data, ROBOT), written)

    def test_an_empty_cloud_has_no_fields(self, serialization):
        message = wire.message_class(CLOUD)(point_step=1)
        message.header.frame_id = CAMERA
        data = bytes(serialization.serialize_message(message))
        with pytest.raises(InputError, match="no field 'x' among"):
            wire.decode_observations(data, ROBOT)


@given(stamps, st.booleans())
def test_the_stamp_of_a_message_is_read_without_the_rest(stamp_ns, is_little_endian):
    data = STORE.serialize_cdr(
        STORE.types["geometry_msgs/msg/PoseStamped"](
            messages.header_of(stamp_ns, "map"), messages_pose()
        ),
        STORE.types["geometry_msgs/msg/PoseStamped"].__msgtype__,
        little_endian=is_little_endian,
    )
    assert wire.peek_stamp(bytes(data)[:12], "it") == stamp_ns


def messages_pose():
    return STORE.types["geometry_msgs/msg/Pose"](
        STORE.types["geometry_msgs/msg/Point"](1.0, 2.0, 0.0),
        STORE.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
    )


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"", "it: 0 bytes are no message with a stamp"),
        (b"\0\1\0\0" + bytes(7), "it: 11 bytes"),
        (b"\0\1\0\0" + bytes(4) + b"\xff" * 4, "it: nanosec = 4294967295"),
    ],
)
def test_a_message_without_a_stamp_is_refused(data, told):
    with pytest.raises(InputError, match=told):
        wire.peek_stamp(data, "it")


@given(stamps, poses, hnp.arrays(float, (3, 3), elements=st.floats(-10, 10)))
def test_an_estimate_is_packed_as_ros_encodes_it(stamp_ns, pose, root):
    own = Estimate(ROBOT, stamp_ns, pose, root @ root.T)
    spatial = np.zeros((6, 6))
    spatial[np.ix_((0, 1, 5), (0, 1, 5))] = own.covariance
    half = float(pose[2]) / 2
    orientation = STORE.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, np.sin(half), np.cos(half))
    place = STORE.types["geometry_msgs/msg/Pose"](
        STORE.types["geometry_msgs/msg/Point"](pose[0], pose[1], 0.0), orientation
    )
    expected = messages.encode(
        messages.PoseWithCovarianceStamped(
            messages.header_of(stamp_ns, "map"),
            STORE.types["geometry_msgs/msg/PoseWithCovariance"](place, spatial.ravel()),
        )
    )
    assert wire.encode_estimate(own) == expected


@pytest.mark.parametrize("count", [0, 1, 50])
def test_many_estimates_are_decoded_as_one_is(count):
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(count, 3, 3))
    own = [
        Estimate(ROBOT, STAMP + i, rng.uniform(-3, 3, 3), root @ root.T)
        for i, root in enumerate(roots)
    ]
    sent = [wire.encode_estimate(estimate) for estimate in own]
    one_by_one = [wire.decode_estimate(data, ROBOT) for data in sent]
    for also in ([], [b"\0\0\0"]):  # padded to another length: not as we lay it out
        many = wire.decode_estimates([data + b"".join(also) for data in sent], ROBOT)
        assert many.stamps_ns.tolist() == [estimate.stamp_ns for estimate in one_by_one]
        assert many.poses.shape == (count, 3)
        assert many.covariances.shape == (count, 3, 3)
        for estimate, pose, covariance in zip(one_by_one, *many[1:], strict=True):
            np.testing.assert_allclose(pose, estimate.pose, atol=1e-12)
            np.testing.assert_array_equal(covariance, estimate.covariance)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"pose": np.array([np.nan, 0, 0])}, "position"),
        ({"covariance": -np.eye(3)}, "not symmetric and positive"),
        ({"covariance": np.triu(np.ones((3, 3)))}, "not symmetric and positive"),
        ({"covariance": np.full((3, 3), np.inf)}, "finite"),
    ],
)
def test_of_many_estimates_a_bad_one_is_refused(change, told):
    good = Estimate(ROBOT, STAMP, np.zeros(3), np.eye(3))
    sent = [wire.encode_estimate(good), wire.encode_estimate(replace(good, **change))]
    with pytest.raises(InputError, match=told):
        wire.decode_estimates(sent, ROBOT)


def general(monkeypatch):
    """Nothing is read in place: all goes through the general reader."""
    monkeypatch.setattr(cdr.Layout, "read", lambda self, data: None)
    monkeypatch.setattr(cdr.Layout, "read_all", lambda self, data: None)
    monkeypatch.setattr(clouds, "_plain_cloud", lambda data, table: None)
    monkeypatch.setattr(poses_wire, "_plain_path", lambda data: None)


def outcome(decode, data):
    """What is decoded, as plain values, or the complaint."""
    try:
        return plain(decode(data))
    except InputError as error:
        return str(error)


def plain(value):
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if is_dataclass(value):
        return [plain(getattr(value, field.name)) for field in fields(value)]
    return [plain(v) for v in value] if isinstance(value, tuple | list) else value


def spoilt(data, rng):
    """The message with a few bytes changed, cut, or more of them."""
    changed_bytes = bytearray(data)
    for place in rng.integers(0, len(data), rng.integers(0, 4)).tolist():
        changed_bytes[place] = rng.choice([0, 1, 127, 128, 255, int(rng.integers(256))])
    end = rng.choice([len(data)] * 6 + [len(data) - 1, int(rng.integers(len(data)))])
    return bytes(changed_bytes[:end]) + bytes(int(rng.integers(5)) * int(rng.random() < 0.3))


READ_IN_PLACE = [
    "pose",
    "observations",
    "sightings",
    "observation_truth",
    "map",
    "estimate",
    "path",
]


@pytest.mark.parametrize("kind", READ_IN_PLACE)
def test_reading_in_place_gives_what_the_general_reader_gives(kind, monkeypatch):
    data, decode = KINDS[kind]
    rng = np.random.default_rng(5)
    messages = [data, *(spoilt(data, rng) for _ in range(1500))]
    # the head is where damage can mislead
    messages += [spoilt(data[:80], rng)[:80].ljust(80, b"\0") + data[80:] for _ in range(1500)]
    found = [outcome(decode, message) for message in messages]
    general(monkeypatch)
    assert found == [outcome(decode, message) for message in messages]
    assert len({str(o) for o in found if isinstance(o, str)}) > 3


@pytest.mark.parametrize("kind", ["pose", "estimate"])
@pytest.mark.parametrize("covariance", ["definite", "singular", "zero", "negative", "uneven"])
def test_many_at_once_are_those_one_by_one(kind, covariance):
    rng = np.random.default_rng(6)
    matrix = {
        "definite": np.diag([1e-9, 3.0, 1e6]),
        "singular": np.ones((3, 3)),
        "zero": np.zeros((3, 3)),
        "negative": np.diag([1.0, 1.0, -1.0]),
        "uneven": np.array([[1, 0.1, 0], [0.2, 1, 0], [0, 0, 1.0]]),
    }[covariance]
    samples = [
        PoseSample(ROBOT, STAMP + i, rng.normal(size=3), rng.normal(size=2), np.diag([1.0, 2, 3]))
        for i in range(20)
    ]
    samples[7] = replace(samples[7], covariance=matrix)
    if kind == "pose":
        messages = [encode_odometry(sample) for sample in samples]
        one, all_of_them = wire.decode_pose, wire.decode_poses
    else:
        estimates = [Estimate(ROBOT, s.stamp_ns, s.pose, s.covariance) for s in samples]
        messages = [wire.encode_estimate(estimate) for estimate in estimates]
        one, all_of_them = wire.decode_estimate, wire.decode_estimates
    if covariance in ("negative", "uneven"):
        for read in (lambda: all_of_them(messages, ROBOT), lambda: one(messages[7], ROBOT)):
            with pytest.raises(InputError, match="not symmetric and positive"):
                read()
        return
    expected = [one(message, ROBOT) for message in messages]
    stamps, found = all_of_them(messages, ROBOT)[:2]
    assert stamps.tolist() == [sample.stamp_ns for sample in expected]
    np.testing.assert_array_equal(found, [sample.pose for sample in expected])


def test_messages_written_in_place_are_those_of_the_general_writer():
    """Decoded and encoded again by rosbags, they are the same bytes."""
    types = {
        "pose": ODOMETRY,
        "path": "nav_msgs/msg/Path",
        "walls": "visualization_msgs/msg/Marker",
    }
    types |= {"estimate": "geometry_msgs/msg/PoseWithCovarianceStamped"}
    types |= {"particles": "geometry_msgs/msg/PoseArray"}
    types |= dict.fromkeys(("step", "diagnostics"), "diagnostic_msgs/msg/DiagnosticArray")
    for kind, name in types.items():
        data = KINDS[kind][0]
        assert bytes(STORE.serialize_cdr(STORE.deserialize_cdr(data, name), name)) == data, kind
    for count in (0, 1, 2, 3):
        paths = {"robot_1": trajectory(count), "röbot": trajectory(count + 1)}
        others = {
            "nav_msgs/msg/Path": wire.encode_path(trajectory(count), STAMP),
            "geometry_msgs/msg/PoseArray": wire.encode_particles(np.ones((count, 3)), STAMP),
            "visualization_msgs/msg/MarkerArray": wire.encode_markers(
                landmark_map(count), paths, STAMP
            ),
            "tf2_msgs/msg/TFMessage": wire.encode_transform(STAMP, "m" * count, "x", np.ones(3)),
        }
        for name, data in others.items():
            assert bytes(STORE.serialize_cdr(STORE.deserialize_cdr(data, name), name)) == data
