"""The RViz and Foxglove configurations show topics that exist, as what they are."""

import inspect
import json
import re
from pathlib import Path

import yaml

from msg_defs import topics, wire
from msg_defs.types import StepRecord

CONFIG = Path(__file__).parents[2] / "config"
TEAM = [topics.robot_name(i) for i in range(3)]
PER_ROBOT = [
    topics.odometry,
    topics.observations,
    topics.ground_truth,
    topics.pose,
    topics.path,
    topics.particles,
]
TOPICS = {t.name: t for _, t in inspect.getmembers(topics) if isinstance(t, topics.Topic)}
TOPICS |= {t.name: t for robot in TEAM for t in (of(robot) for of in PER_ROBOT)}
TYPES = {"PoseWithCovariance": "PoseWithCovarianceStamped"}
DURABILITY = {topics.LATCHED: "Transient Local"}
RELIABILITY = {topics.SENSOR: "Best Effort"}


def _displays(displays):
    for display in displays:
        yield from _displays(display.get("Displays", []))
        if "Topic" in display:
            yield display


def test_rviz_subscribes_with_the_type_and_quality_of_service_that_is_published():
    manager = yaml.safe_load((CONFIG / "rviz.rviz").read_text())["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == topics.MAP_FRAME
    displays = list(_displays(manager["Displays"]))
    for display in displays:
        topic = TOPICS[display["Topic"]["Value"]]
        shown = display["Class"].removeprefix("rviz_default_plugins/")
        assert TYPES.get(shown, shown) == topic.type.split("/")[-1]
        assert display["Topic"]["Durability Policy"] == DURABILITY.get(topic.qos, "Volatile")
        assert display["Topic"]["Reliability Policy"] == RELIABILITY.get(topic.qos, "Reliable")
    assert {of(robot).name for robot in TEAM for of in PER_ROBOT} <= {
        display["Topic"]["Value"] for display in displays
    }


def _panels(layout):
    if isinstance(layout, str):
        return {layout}
    return _panels(layout["first"]) | _panels(layout["second"])


def test_foxglove_places_every_panel_and_reads_known_topics():
    layout = json.loads((CONFIG / "foxglove.json").read_text())
    panels = layout["configById"]
    assert _panels(layout["layout"]) == set(panels)
    scene = panels["3D!team"]
    assert scene["followTf"] == topics.MAP_FRAME
    plotted = [path["value"] for panel in panels.values() for path in panel.get("paths", [])]
    read = {*scene["topics"], *(re.match(r"[\w/]+", path).group() for path in plotted)}
    read.add(panels["DiagnosticSummary!health"]["topicToRender"])
    assert read <= {"/" + name.removeprefix("/") for name in TOPICS}


def test_foxglove_plots_numbers_that_are_published():
    layout = json.loads((CONFIG / "foxglove.json").read_text())
    paths = [p["value"] for panel in layout["configById"].values() for p in panel.get("paths", [])]
    step = StepRecord(0, 0, (), (), effective_particles=2.5, resampled=False, duration_ms=4.0)
    _, (published,) = wire.decode_diagnostics(wire.encode_step(step))
    assert paths
    for path in paths:
        key = re.fullmatch(r'/fusion/steps\.status\[0\].values\[:\]{key=="(\w+)"}\.value', path)[1]
        assert float(published.values[key]) > 0
