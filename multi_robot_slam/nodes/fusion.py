"""ROS: odometry and observations of the team in, poses and the landmark map out."""

import re
import sys
import time
from collections.abc import Callable
from typing import Annotated, TypeVar

import numpy as np
from annotated_types import Ge, Gt
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from std_srvs.srv import SetBool, Trigger

from msg_defs import topics
from msg_defs.errors import InputError
from msg_defs.ros import environment
from msg_defs.ros.endpoints import Audience, subscribe
from msg_defs.ros.parameters import declare
from msg_defs.ros.spin import SPIN_TIMEOUT_S, EdgeNode, spin
from msg_defs.ros.usage import Usage
from msg_defs.types import Event, PoseSample, StepRecord, settings
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.nodes.health import Health
from multi_robot_slam.nodes.inbox import Inbox, Message
from multi_robot_slam.nodes.keeping import Autosave, Keeping, Resumed, loaded, save
from multi_robot_slam.nodes.outputs import Outputs
from multi_robot_slam.nodes.silence import Silence
from multi_robot_slam.pipeline.decoding import Decode, inputs
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.pipeline.rewind import Rewind

Answer = TypeVar("Answer", Trigger.Response, SetBool.Response)

DIAGNOSTICS_PERIOD_S = 1.0
PROGRESS_PERIOD_S = 0.9
WARNING_PERIOD_S = 5.0
POLL_S = 0.01


@settings
class Publishing:
    """What the node does with the estimate."""

    picture_period_s: Annotated[float, Gt(0), "time between two maps, paths, particles [s]"] = 1.0
    idle_s: Annotated[float, Gt(0), "silence after which frames held back are filtered [s]"] = 2.0
    stop_after_s: Annotated[float, Ge(0), "silence after which the node ends; 0 is never [s]"] = 0.0
    silent_s: Annotated[float, Gt(0), "silence after which a robot is reported [s]"] = 5.0
    publish_tf: Annotated[bool, "publish the transform map -> <robot>/odom"] = True
    unheard_s: Annotated[
        float, Gt(0), "time after which an expected topic that was never heard is reported [s]"
    ] = 10.0
    inbox_mb: Annotated[
        float, Gt(0), "most memory for messages that wait; then the oldest frames are lost [MB]"
    ] = 1000.0
    subscribers: Annotated[
        int, Ge(0), "subscribers to wait for on fusion/steps and each pose before filtering"
    ] = 0


USAGE = Usage(
    "multi_robot_slam fusion",
    "Estimate one landmark map and all robots' paths from the team's odometry and observations. "
    "/diagnostics says of each robot whether it is consistent, noisier than told, started wrong, "
    "or lost, with cause, numbers and remedy; docs/monitor.md has how to read it. Services: "
    "~/save_map and ~/load_map (std_srvs/Trigger) write and load the files that the parameters "
    "map_out and map name; ~/reset (Trigger) begins anew; ~/pause (SetBool) uses nothing that "
    "arrives.",
    (Config, Publishing, Keeping),
    SECTION,
)


class Fusion(EdgeNode):
    """Decodes what arrives, hands it to the pipeline, publishes what comes back.

    Messages wait in an inbox: however long a step takes, none is lost. When time goes back,
    of `/clock` under use_sim_time or of the whole team's stamps, the fusion starts over.
    """

    def __init__(self) -> None:
        super().__init__("fusion")
        config, self._settings, keeping = declare(self, *USAGE.classes, section=USAGE.section)
        self._config, self._keeping = config, keeping
        self._warned_s: dict[str, float] = {}
        self._health = Health(config.robots, self._settings.silent_s)
        self._kept = loaded(keeping.map, config)
        self._autosave = None
        self._resumed: Resumed | None = None
        if keeping.autosave:
            self._autosave = Autosave(keeping.autosave, config, self._warn)
            self._resumed = self._autosave.resumed()
        self._begin()
        if self._resumed:
            self._pipeline = self._resumed.pipeline
        self.get_logger().info("loading the filter, which is compiled the first time")
        self._pipeline.warm_up()
        self._inbox = Inbox(1e6 * self._settings.inbox_mb, self._lose)
        self._outputs = Outputs(self, config, self._settings.publish_tf)
        count = self._settings.subscribers
        self._audience = Audience(self, [(one, count) for one in self._outputs.lossless()])
        heard = [self._listen(topic, *how) for topic, how in inputs(config).items()]
        self._silence = Silence(heard, self._settings.unheard_s)
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1))
        self._jumps = self.get_clock().create_jump_callback(
            back, post_callback=lambda _: self._rewind.clock_went_back()
        )
        self.create_timer(self._settings.picture_period_s, self._publish_pictures)
        self.every(DIAGNOSTICS_PERIOD_S, self._publish_diagnostics)
        if self._autosave and keeping.autosave_s:
            self.every(keeping.autosave_s, self._save_state)
        self.create_service(Trigger, "~/save_map", self._save_map)
        self.create_service(Trigger, "~/load_map", self._load_map)
        self.create_service(Trigger, "~/reset", self._reset)
        self.create_service(SetBool, "~/pause", self._pause)
        self.get_logger().info(f"ready for {', '.join(config.robots)}; {environment.reach()}")

    def work(self) -> float:
        """Handle the oldest message; after a silence, the frames held back."""
        silence_s = self._health.silence_s()
        if self._inbox and self._audience.is_missing():
            return POLL_S
        if self._inbox:
            self._handle(self._inbox.get())
        elif self._pipeline.pending and silence_s > self._settings.idle_s:
            self._publish_steps(self._pipeline.finish())
            self._publish_pictures()
        elif 0 < self._settings.stop_after_s < silence_s < np.inf:
            self.done = not self._pipeline.pending
        return 0.0 if self._inbox else SPIN_TIMEOUT_S

    def close(self) -> None:
        """Publish the final paths, map and counts; what it ends by an exception is gone on from."""
        self._publish_pictures(are_whole=True)
        messages, frames = len(self._inbox), self._pipeline.pending
        if messages or frames:
            self._warn(f"ended with {messages} messages and {frames} frames unfiltered")
        self._publish_diagnostics()
        if self._autosave and not self._resumed and sys.exception() is None:
            self._autosave.end(self._pipeline, self._newest_ns())
        self._pipeline.close()

    def _begin(self) -> None:
        self._pipeline = Pipeline(self._config, self._warn, keeps_frames=False, kept=self._kept)
        self._rewind = Rewind(self._config.apart_ns)
        self._has_news = False
        self._saved_ns = 0

    def _listen(self, topic: topics.Topic, robot: str, decode: Decode) -> topics.Topic:
        """Put what comes on a topic of `robot` into the inbox; the topic with its whole name."""
        is_odometry = topic == topics.odometry(robot)

        def keep(data: bytes) -> None:
            self._health.hear(robot)
            self._silence.hear(reader.topic_name)
            if not self._health.is_paused:
                self._inbox.put(Message(time.monotonic(), topic, decode, data, not is_odometry))

        reader = subscribe(self, topic, keep)
        return topic._replace(name=reader.topic_name)

    def _lose(self, message: Message) -> None:
        name = message.topic.name
        text = f"dropped a message of {name}: more wait than inbox_mb = {self._settings.inbox_mb:g}"
        self._pipeline.lose(f"inbox full: {name}", f"{text}; use fewer particles, or raise it")

    def _handle(self, message: Message) -> None:
        self._health.lag_s = time.monotonic() - message.arrived_s
        try:
            event = message.decode(message.data)
        except InputError as error:
            self._pipeline.refuse(error)
        else:
            if self._resumed:
                self._confirm(self._resumed, event)
            if self._rewind.note(event):
                self._start_over()
            else:
                self._take(event)

    def _take(self, event: Event) -> None:
        """Hand an event to the pipeline, and publish what comes of it."""
        self._publish_steps(self._pipeline.handle(event))
        prediction = self._pipeline.predict(event)
        if prediction and isinstance(event, PoseSample):
            self._outputs.prediction(prediction, event.pose)

    def _confirm(self, resumed: Resumed, event: Event) -> None:
        """Go on after a crash, if this first event comes soon enough; otherwise begin anew."""
        self._resumed = None
        late_s = (event.stamp_ns - resumed.stamp_ns) / 1e9
        if -self._config.apart_ns / 1e9 <= late_s <= self._keeping.resume_s:
            self.get_logger().info(f"going on {late_s:.1f} s after the state in the autosave")
            resumed.pipeline.pause()
        else:
            self._warn(
                f"not going on from the autosave, but beginning anew: {late_s:.1f} s have passed, "
                f"and resume_s = {self._keeping.resume_s:g}"
            )
            self._begin_anew()

    def _begin_anew(self) -> None:
        self._pipeline.close()
        self._resumed = None
        self._begin()
        self._health.start_over()

    def _start_over(self) -> None:
        """End one run, and begin another with what has come of it already."""
        self.get_logger().warning("time went back: starting over with the same configuration")
        self._publish_steps(self._pipeline.finish())
        self._publish_pictures(are_whole=True)
        beginning = self._rewind.beginning()
        self._begin_anew()
        for event in beginning:
            self._rewind.note(event)
            self._take(event)

    def _newest_ns(self) -> int:
        """Stamp of the newest step; 0: there was none."""
        return self._health.step.stamp_ns if self._health.step else 0

    def _save_state(self) -> None:
        """Unless there is nothing new since the last one."""
        newest_ns = self._newest_ns()
        is_new = newest_ns > self._saved_ns
        if self._autosave and is_new and self._autosave.save(self._pipeline, newest_ns):
            self._saved_ns = newest_ns

    def _save_map(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def done() -> str:
            file = str(self.get_parameter("map_out").value)
            return save(file, self._config, self._pipeline, self._newest_ns())

        return self._answered(response, done)

    def _load_map(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def done() -> str:
            file = str(self.get_parameter("map").value)
            kept = loaded(file, self._config)
            if kept is None:
                raise InputError("map is empty; name a file: ros2 param set /fusion map FILE")
            self._kept = kept
            self._begin_anew()
            return f"begun anew in {file} with {int(kept.published.sum())} landmarks"

        return self._answered(response, done)

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._begin_anew()
        return self._answered(response, lambda: "begun anew")

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if self._health.is_paused and not request.data:
            self._pipeline.pause()
        self._health.is_paused = bool(request.data)
        return self._answered(response, lambda: "paused" if request.data else "going on")

    def _answered(self, response: Answer, done: Callable[[], str]) -> Answer:
        """The answer of a service: what was done, or why it could not be."""
        try:
            response.success, response.message = True, done()
            self.get_logger().info(response.message)
        except InputError as error:
            response.success, response.message = False, str(error)
            self.get_logger().warning(response.message)
        return response

    def _publish_steps(self, steps: list[StepRecord]) -> None:
        for step in steps:
            self._health.note(step, self._pipeline.dropped.total())
        self._outputs.steps(steps, self._pipeline)
        self._has_news |= bool(steps)

    def _publish_pictures(self, are_whole: bool = False) -> None:
        step = self._health.step
        if step is None or not (self._has_news or are_whole):
            return
        self._has_news = False
        self._health.landmarks = self._outputs.pictures(step.stamp_ns, self._pipeline, are_whole)
        self.get_logger().info(self._health.progress(), throttle_duration_sec=PROGRESS_PERIOD_S)

    def _publish_diagnostics(self) -> None:
        for line in self._silence.news(self._published_by_others):
            self.get_logger().warning(line)
        dropped, pending = self._pipeline.dropped, self._pipeline.pending
        statuses = self._health.statuses(
            len(self._inbox),
            pending,
            dropped,
            self._silence.told,
            self._pipeline.frames(),
            self._pipeline.lost(),
        )
        self._outputs.diagnostics(self.get_clock().now().nanoseconds, statuses)

    def _published_by_others(self) -> dict[str, str]:
        """The type of every topic that somebody else publishes, by whole name."""
        known = self.get_topic_names_and_types()
        own = self._outputs.names
        return {n: types[0] for n, types in known if n not in own and self.count_publishers(n)}

    def _warn(self, text: str) -> None:
        """Tell of a loss; of those that differ in numbers only, one in a while."""
        kind, now_s = re.sub(r"\b[\d.]+", "", text), time.monotonic()
        if now_s - self._warned_s.get(kind, -np.inf) > WARNING_PERIOD_S:
            self._warned_s[kind] = now_s
            self.get_logger().warning(text)


def main(args: list[str] | None = None) -> int:
    """Run the fusion until interrupted; the exit code."""
    return spin(Fusion, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
