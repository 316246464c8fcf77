"""Pictures: nothing is lost, other makers' are read, the damaged and the absurd are refused."""

import tracemalloc
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore

from msg_defs import wire
from msg_defs.errors import InputError
from msg_defs.types import CameraInfo, Image
from msg_defs.wire import images, messages

STAMP = 1_700_000_000_123_456_789
STORE = get_typestore(Stores.ROS2_JAZZY)
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
WHAT = "left image of robot_2"
PACKABLE = ["mono8", "bgr8", "bgra8", "mono16", "bgr16", "bgra16", "16UC1", "8UC1", "bayer_grbg8"]


def picture(encoding, height=5, width=6, seed=0):
    kind = wire.ENCODINGS[encoding]
    shape = (height, width, kind.channels)[: 2 + (kind.channels > 1)]
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, np.iinfo(kind.dtype).max, shape, kind.dtype, endpoint=True)
    return Image(STAMP, "röbot/left", encoding, pixels)


def smooth(encoding, height=48, width=64):
    """A picture that JPEG keeps nearly as it is."""
    image = picture(encoding, height, width)
    return replace(image, pixels=cv2.GaussianBlur(image.pixels, (0, 0), 4))


def assert_same(read, written):
    assert (read.stamp_ns, read.frame, read.encoding) == (
        written.stamp_ns,
        written.frame,
        written.encoding,
    )
    np.testing.assert_array_equal(read.pixels, written.pixels, strict=True)


def changed(sent, type_name, **values):
    message = STORE.deserialize_cdr(sent, type_name)
    for name, value in values.items():
        *path, last = name.split("__")
        target = message
        for part in path:
            target = getattr(target, part)
        setattr(target, last, value)
    return bytes(STORE.serialize_cdr(message, type_name))


def decoded_by_mcap(data, type_name):
    text = wire.message_schema(type_name)[0]
    schema = Schema(id=1, name=type_name, encoding="ros2msg", data=text.encode())
    return DecoderFactory().decoder_for("cdr", schema)(data)


class TestRaw:
    @pytest.mark.parametrize("encoding", wire.ENCODINGS)
    @given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 99), st.integers(0, 2**31 - 1))
    def test_a_picture_comes_back(self, encoding, height, width, seed, stamp):
        written = replace(picture(encoding, height, width, seed), stamp_ns=stamp)
        assert_same(wire.decode_image(wire.encode_image(written), WHAT), written)

    @pytest.mark.parametrize("encoding", ["mono8", "rgb8", "mono16", "bgra16", "yuv422"])
    @pytest.mark.parametrize("padding", [0, 1, 7])
    @pytest.mark.parametrize("is_bigendian", [0, 1])
    @pytest.mark.parametrize("is_little", [True, False])
    def test_any_legal_arrangement(self, encoding, padding, is_bigendian, is_little):
        """Padded rows, pixels in either byte order, and messages in either."""
        written = picture(encoding)
        order = ">" if is_bigendian else "<"
        stored = np.ascontiguousarray(written.pixels).astype(
            written.pixels.dtype.newbyteorder(order)
        )
        rows = stored.reshape(5, -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xAB)
        message = messages.Image(
            messages.header_of(STAMP, written.frame),
            5,
            6,
            encoding,
            is_bigendian,
            rows.shape[1],
            rows.ravel(),
        )
        data = bytes(STORE.serialize_cdr(message, IMAGE, little_endian=is_little))
        assert_same(wire.decode_image(data, WHAT), written)

    @pytest.mark.parametrize("encoding", wire.ENCODINGS)
    def test_other_readers_see_the_same(self, encoding):
        written = picture(encoding)
        data = wire.encode_image(written)
        for read in (STORE.deserialize_cdr(data, IMAGE), decoded_by_mcap(data, IMAGE)):
            assert read.header.frame_id == "röbot/left"
            assert read.header.stamp.sec * 10**9 + read.header.stamp.nanosec == STAMP
            assert (read.height, read.width, read.encoding) == (5, 6, encoding)
            assert (read.is_bigendian, read.step) == (0, written.pixels[0].nbytes)
            assert bytes(read.data) == written.pixels.tobytes()

    def test_a_view_of_a_picture_is_written_as_it_looks(self):
        whole = picture("bgr8", 8, 9)
        written = replace(whole, pixels=whole.pixels[1:7:2, 2:8])
        read = wire.decode_image(wire.encode_image(written), WHAT)
        np.testing.assert_array_equal(read.pixels, written.pixels)

    def test_pixels_in_native_order_are_not_copied(self):
        for encoding in ("mono8", "rgb8", "mono16"):
            data = wire.encode_image(picture(encoding, 480, 640))
            tracemalloc.start()
            wire.decode_image(data, WHAT)
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            assert peak < 100_000

    @pytest.mark.parametrize(
        ("values", "told"),
        [
            ({"encoding": "32FC1"}, "encoding '32FC1' is not read; publish mono8"),
            ({"encoding": ""}, "encoding '' is not read"),
            ({"encoding": "mono16"}, "step is at least 12"),
            ({"step": 5}, "step 5 and 30 bytes of data disagree; step is at least 6"),
            ({"step": 7}, "step 7"),
            ({"step": 0}, "step 0"),
            ({"height": 6}, "height 6"),
            ({"height": 4}, "height 4"),
            ({"width": 7}, "width 7"),
            ({"width": 10**9}, "width 1000000000"),
            ({"width": 2**32 - 1, "height": 2**32 - 1, "step": 2**32 - 1}, "width 4294967295"),
            ({"height": 0, "data": np.empty(0, np.uint8)}, "6 x 0 pixels"),
            ({"width": 0}, "0 x 5 pixels"),
            ({"data": np.zeros(29, np.uint8)}, "29 bytes"),
            ({"data": np.zeros(31, np.uint8)}, "31 bytes"),
            ({"header__stamp__nanosec": 10**9}, "nanosec"),
        ],
    )
    def test_what_contradicts_itself_is_refused(self, values, told):
        data = changed(wire.encode_image(picture("mono8")), IMAGE, **values)
        with pytest.raises(InputError, match=f"^{WHAT}: .*{told}") as caught:
            wire.decode_image(data, WHAT)
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize(
        ("encoding", "pixels"),
        [
            ("mono8", np.zeros((4, 4), np.uint16)),
            ("mono8", np.zeros((4, 4, 1), np.uint8)),
            ("bgr8", np.zeros((4, 4, 4), np.uint8)),
            ("bgr8", np.zeros((4, 4), np.uint8)),
            ("mono16", np.zeros((4, 4))),
        ],
    )
    @pytest.mark.parametrize("encode", [wire.encode_image, wire.encode_compressed])
    def test_pixels_that_are_not_what_the_encoding_says_are_refused(self, encode, encoding, pixels):
        with pytest.raises(InputError, match=rf"pixels {pixels.dtype} .* are not {encoding}"):
            encode(Image(0, "", encoding, pixels))


class TestCompressed:
    @pytest.mark.parametrize("encoding", PACKABLE)
    def test_png_loses_nothing(self, encoding):
        written = picture(encoding, 7, 9)
        assert_same(wire.decode_compressed(wire.encode_compressed(written, "png"), WHAT), written)

    @pytest.mark.parametrize("encoding", ["mono8", "bgr8"])
    def test_jpeg_loses_little_and_less_with_quality(self, encoding):
        written = smooth(encoding)
        errors = []
        for quality in (20, 95):
            data = wire.encode_compressed(written, "jpeg", quality)
            read = wire.decode_compressed(data, WHAT)
            assert (read.encoding, read.pixels.shape) == (encoding, written.pixels.shape)
            errors.append(np.abs(read.pixels.astype(int) - written.pixels).mean())
        assert errors[1] < 1 < errors[0]

    @pytest.mark.parametrize("format", ["", "jpeg", "rgb8; jpeg compressed bgr8", "mono16; png"])
    def test_whatever_the_format_says_the_picture_decides(self, format):
        written = smooth("bgr8")
        data = changed(wire.encode_compressed(written), COMPRESSED, format=format)
        read = wire.decode_compressed(data, WHAT)
        assert read.encoding == "bgr8"
        np.testing.assert_allclose(read.pixels.astype(int), written.pixels, atol=12)

    @pytest.mark.parametrize(
        "encoding",
        [name for name in wire.ENCODINGS if name not in PACKABLE and "bayer" not in name],
    )
    def test_what_a_format_cannot_hold_is_refused(self, encoding):
        with pytest.raises(InputError, match=f"{encoding} cannot be written as png; use"):
            wire.encode_compressed(picture(encoding), "png")

    @pytest.mark.parametrize("encoding", ["mono16", "bgra8", "bgr16", "bayer_rggb16"])
    def test_jpeg_has_eight_bits_and_is_opaque(self, encoding):
        with pytest.raises(InputError, match=f"{encoding} cannot be written as jpeg; use"):
            wire.encode_compressed(picture(encoding), "jpeg")

    @pytest.mark.parametrize("format", ["jpeg", "png"])
    def test_a_picture_that_was_cut_off_is_refused(self, format):
        data = wire.encode_compressed(smooth("mono8"), format)
        packed = STORE.deserialize_cdr(data, COMPRESSED).data
        for size in range(len(packed)):
            with pytest.raises(InputError, match=f"^{WHAT}: .*; publish"):
                wire.decode_compressed(changed(data, COMPRESSED, data=packed[:size]), WHAT)

    def test_cameras_that_pad_jpeg_with_zeros_are_read(self):
        data = wire.encode_compressed(smooth("mono8"))
        packed = STORE.deserialize_cdr(data, COMPRESSED).data
        padded = changed(data, COMPRESSED, data=np.append(packed, np.zeros(99, np.uint8)))
        assert_same(wire.decode_compressed(padded, WHAT), wire.decode_compressed(data, WHAT))

    @pytest.mark.parametrize(
        ("format", "at"), [("jpeg", b"\xff\xc0\x00\x0b\x08"), ("png", b"IHDR")]
    )
    def test_a_picture_that_would_fill_the_memory_is_refused(self, format, at):
        data = wire.encode_compressed(smooth("mono8"), format)
        packed = bytearray(STORE.deserialize_cdr(data, COMPRESSED).data)
        place = packed.index(at) + len(at)
        size = 4 if format == "jpeg" else 8
        for sides, told in ((b"\x3f", "16191|1061109567"), (b"\0", "0 x 0")):
            packed[place : place + size] = sides * size
            with pytest.raises(InputError, match=told):
                wire.decode_compressed(
                    changed(data, COMPRESSED, data=np.frombuffer(bytes(packed), np.uint8)), WHAT
                )

    @pytest.mark.parametrize(
        ("packed", "told"),
        [
            (b"", "0 bytes"),
            (b"BM" + bytes(50), "begin with 42 4d 00 00 are no JPEG or PNG"),
            (bytes(12) + images._PNG_START + bytes(9) + images._PNG_END, "begin with 00 00 00 00"),
            (images._JPEG_START + images._JPEG_END, "0 x 0 pixels"),
            (images._PNG_START + bytes(20) + images._PNG_END, "0 x 0 pixels"),
        ],
    )
    def test_what_is_no_picture_is_refused(self, packed, told):
        data = wire.encode_compressed(picture("mono8"))
        data = changed(data, COMPRESSED, data=np.frombuffer(packed, np.uint8), format="x")
        with pytest.raises(InputError, match=f"^{WHAT}: .*{told}.*; publish"):
            wire.decode_compressed(data, WHAT)

    @pytest.mark.parametrize("format", ["jpeg", "png"])
    @given(st.lists(st.tuples(st.integers(3, 10**4), st.integers(0, 255)), min_size=1, max_size=6))
    def test_damage_never_crashes(self, format, patches):
        data = wire.encode_compressed(smooth("bgr8", 16, 16), format)
        packed = STORE.deserialize_cdr(data, COMPRESSED).data.copy()
        for place, value in patches:
            packed[place % len(packed)] = value
        told = ""
        try:
            wire.decode_compressed(changed(data, COMPRESSED, data=packed), WHAT)
        except InputError as error:
            told = str(error)
        assert "\n" not in told

    @pytest.mark.parametrize("format", ["jpeg", "png"])
    def test_other_readers_see_the_same(self, format):
        data = wire.encode_compressed(smooth("bgr8"), format)
        for read in (STORE.deserialize_cdr(data, COMPRESSED), decoded_by_mcap(data, COMPRESSED)):
            assert (read.header.frame_id, read.format) == (
                "röbot/left",
                f"bgr8; {format} compressed ",
            )
            pixels = cv2.imdecode(np.frombuffer(read.data, np.uint8), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(pixels, wire.decode_compressed(data, WHAT).pixels)


finite = st.floats(allow_nan=False, allow_infinity=False)


class TestCameraInfo:
    INFO = CameraInfo(
        STAMP,
        "röbot/left",
        752,
        480,
        "plumb_bob",
        np.arange(5) / 7,
        np.arange(9).reshape(3, 3) / 3,
        np.eye(3) * 0.9,
        np.arange(12).reshape(3, 4) * 1.1,
    )

    @given(
        hnp.arrays(float, st.integers(0, 14), elements=finite),
        hnp.arrays(float, (3, 3), elements=finite),
        hnp.arrays(float, (3, 3), elements=finite),
        hnp.arrays(float, (3, 4), elements=finite),
        st.integers(0, 2**32 - 1),
    )
    def test_a_calibration_comes_back(self, distortion, intrinsics, rotation, projection, width):
        written = CameraInfo(
            5, "x", width, 480, "equidistant", distortion, intrinsics, rotation, projection
        )
        read = wire.decode_camera_info(wire.encode_camera_info(written), WHAT)
        for name, value in vars(written).items():
            np.testing.assert_array_equal(getattr(read, name), value, strict=True)

    def test_other_readers_see_the_same(self):
        data = wire.encode_camera_info(self.INFO)
        for read in (STORE.deserialize_cdr(data, INFO), decoded_by_mcap(data, INFO)):
            assert (read.width, read.height, read.distortion_model) == (752, 480, "plumb_bob")
            assert (read.binning_x, read.binning_y, read.roi.width) == (0, 0, 0)
            for values, expected in zip(
                (read.d, read.k, read.r, read.p),
                (
                    self.INFO.distortion,
                    self.INFO.intrinsics,
                    self.INFO.rotation,
                    self.INFO.projection,
                ),
                strict=True,
            ):
                np.testing.assert_array_equal(values, expected.ravel())

    @pytest.mark.parametrize(
        ("values", "told"),
        [
            ({"d": np.array([0, np.nan])}, r"D\[1\] = nan"),
            ({"k": np.full(9, np.inf)}, r"K\[0\] = inf"),
            ({"r": np.full(9, -np.inf)}, r"R\[0\] = -inf"),
            ({"p": np.full(12, np.nan)}, r"P\[0\] = nan"),
            ({"binning_x": 2, "binning_y": 2}, "binning 2 x 2; publish"),
            ({"binning_y": 4}, "binning 0 x 4; publish"),
            ({"roi__width": 100, "roi__height": 90}, "region of interest 100 x 90 at 0, 0; pub"),
            ({"roi__x_offset": 7}, "at 7, 0; publish"),
            ({"header__stamp__nanosec": 10**9}, "nanosec"),
        ],
    )
    def test_what_is_no_calibration_of_the_whole_image_is_refused(self, values, told):
        data = changed(wire.encode_camera_info(self.INFO), INFO, **values)
        with pytest.raises(InputError, match=f"^{WHAT}: .*{told}"):
            wire.decode_camera_info(data, WHAT)

    @pytest.mark.parametrize(
        "values",
        [
            {"binning_x": 1, "binning_y": 1},
            {"roi__width": 752, "roi__height": 480},
            {"p": np.zeros(12), "k": np.zeros(9), "width": 0, "height": 0},
        ],
    )
    def test_what_drivers_write_of_the_whole_image_is_read(self, values):
        data = changed(wire.encode_camera_info(self.INFO), INFO, **values)
        assert wire.decode_camera_info(data, WHAT).distortion_model == "plumb_bob"
