"""What a camera node says of its health; the clock stands still."""

from dataclasses import replace

import pictures
import tag_pictures

from msg_defs import wire
from multi_robot_slam.front_end.front_end import FrontEnd
from multi_robot_slam.front_end.settings import CameraSettings, TagSettings
from multi_robot_slam.nodes.camera_health import CameraHealth
from multi_robot_slam.pipeline.cameras import Camera


def healthy(seen):
    """The status of a camera whose pictures came, were paired, and showed `seen`."""
    camera = Camera(pictures.team(), "robot_1", [].append)
    health = CameraHealth(camera, 2.0, clock=lambda: 0.0)
    for _, topic, data in pictures.drive(steps=1):
        if topic in camera.inputs:
            camera.take(topic, data)
            health.hear(topic)
    health.see(seen, 1.0)
    return health.status([])


def seen_with(settings):
    images = tag_pictures.pair([tag_pictures.Tag(3, (0.1, 0.0, 1.2))])
    return FrontEnd(tag_pictures.RIG, CameraSettings(tags=settings)).observe(*images)


def test_a_wrong_size_of_the_tags_is_told_with_the_right_one():
    settings = TagSettings(family="36h11", size_m=tag_pictures.SIZE_M)
    status = healthy(seen_with(settings))
    assert "size_m" not in status.message
    assert status.values["tags matched"] == "1"
    status = healthy(seen_with(replace(settings, size_m=0.3)))
    assert status.level == wire.WARN
    assert "camera.tags.size_m; the sides look 0.16" in status.message
    assert status.values["tags other size"] == "1"


def test_without_tags_nothing_is_said_of_them():
    assert not any("tag" in key for key in healthy(seen_with(TagSettings())).values)
