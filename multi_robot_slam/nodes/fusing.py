"""One fusion between *configure* and *cleanup*: messages in, estimates out."""

import re
import time
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration

from msg_defs import topics
from msg_defs.errors import InputError
from msg_defs.limits import AT_ANY_TIME
from msg_defs.ros.endpoints import Audience, Reader, subscribe
from msg_defs.ros.spin import SPIN_TIMEOUT_S, EdgeNode
from msg_defs.types import Event, PoseSample, StepRecord, settings
from multi_robot_slam.config import Config
from multi_robot_slam.filter.kept import KeptMap
from multi_robot_slam.nodes.health import Health
from multi_robot_slam.nodes.inbox import Inbox, Message
from multi_robot_slam.nodes.keeping import Autosave, Keeping, Resumed, loaded
from multi_robot_slam.nodes.outputs import Outputs
from multi_robot_slam.nodes.rivals import rival
from multi_robot_slam.nodes.silence import Silence
from multi_robot_slam.pipeline.decoding import Decode, inputs
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.pipeline.rewind import Rewind

PROGRESS_PERIOD_S = 0.9
WARNING_PERIOD_S = 5.0
POLL_S = 0.01


@settings
class Publishing:
    """What the node does with the estimate."""

    picture_period_s: Annotated[
        float, Gt(0), AT_ANY_TIME, "time between two maps, paths, particles [s]"
    ] = 1.0
    idle_s: Annotated[float, Gt(0), "silence after which frames held back are filtered [s]"] = 2.0
    stop_after_s: Annotated[
        float, Ge(0), AT_ANY_TIME, "silence after which the node ends; 0 is never [s]"
    ] = 0.0
    silent_s: Annotated[
        float, Gt(0), AT_ANY_TIME, "silence after which a robot is reported [s]"
    ] = 5.0
    publish_tf: Annotated[bool, AT_ANY_TIME, "publish the transform map -> <robot>/odom"] = True
    unheard_s: Annotated[
        float,
        Gt(0),
        AT_ANY_TIME,
        "time after which an expected topic that was never heard is reported [s]",
    ] = 10.0
    inbox_mb: Annotated[
        float, Gt(0), "most memory for messages that wait; then the oldest frames are lost [MB]"
    ] = 1000.0
    subscribers: Annotated[
        int, Ge(0), "subscribers to wait for on fusion/steps and each pose before filtering"
    ] = 0


class Fusing:
    """Decodes what arrives, hands it to the pipeline, publishes what comes back.

    Messages wait in an inbox: however long a step takes, none is lost. When time goes back,
    of `/clock` under use_sim_time or of the whole team's stamps, the fusion starts over.

    Parameters
    ----------
    node : whose topics these are. `InputError` where there is no such map, or nothing to begin in.

    """

    def __init__(
        self, node: EdgeNode, config: Config, publishing: Publishing, keeping: Keeping
    ) -> None:
        self._node, self.config = node, config
        self._settings, self._keeping = publishing, keeping
        self._warned_s: dict[str, float] = {}
        self._has_news, self._saved_ns = False, 0
        self.health = Health(config.robots, publishing.silent_s)
        self._kept = loaded(keeping.map, config)
        self._autosave = None
        self._resumed: Resumed | None = None
        if keeping.autosave:
            self._autosave = Autosave(keeping.autosave, config, self._warn)
            self._resumed = self._autosave.resumed()
        self._begin(self._pipeline())
        if self._resumed:
            self.pipeline = self._resumed.pipeline
        node.get_logger().info("loading the filter, which is compiled the first time")
        self.pipeline.warm_up()
        self.inbox = Inbox(1e6 * publishing.inbox_mb, self._lose)
        self._outputs = Outputs(node, config, publishing.publish_tf)
        count = publishing.subscribers
        self._audience = Audience(node, [(one, count) for one in self._outputs.lossless()])
        self._readers: list[Reader] = []
        heard = [self._listen(topic, *how) for topic, how in inputs(config).items()]
        self._silence = Silence(heard, publishing.unheard_s)
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1))
        self._jumps = node.get_clock().create_jump_callback(
            back, post_callback=lambda _: self._rewind.clock_went_back()
        )

    def take(self, config: Config, publishing: Publishing, keeping: Keeping) -> None:
        """Go on with other settings; of `config` those count when it begins anew."""
        self.config, self._settings, self._keeping = config, publishing, keeping
        self._outputs.publishes_tf = publishing.publish_tf
        self.health.silent_s = publishing.silent_s
        self._silence.wait_s = publishing.unheard_s

    def work(self) -> float:
        """Handle the oldest message; after a silence, the frames held back."""
        silence_s = self.health.silence_s()
        if self.inbox and self._audience.is_missing():
            return POLL_S
        if self.inbox:
            self._handle(self.inbox.get())
        elif self.pipeline.pending and silence_s > self._settings.idle_s:
            self._publish_steps(self.pipeline.finish())
            self.publish_pictures()
        elif 0 < self._settings.stop_after_s < silence_s < np.inf:
            self._node.done = not self.pipeline.pending
        return 0.0 if self.inbox else SPIN_TIMEOUT_S

    def close(self, is_in_order: bool) -> None:
        """Publish the final paths, map and counts; unless `is_in_order` it is gone on from."""
        self.publish_pictures(are_whole=True)
        messages, frames = len(self.inbox), self.pipeline.pending
        if messages or frames:
            self._warn(f"ended with {messages} messages and {frames} frames unfiltered")
        self.publish_diagnostics()
        if self._autosave and not self._resumed and is_in_order:
            self._autosave.end(self.pipeline, self.newest_ns())
        self.pipeline.close()

    def release(self) -> None:
        """Let go of all topics."""
        self._jumps.unregister()
        for reader in self._readers:
            reader.close()
        self._outputs.close()

    def begin_anew(self, kept: KeptMap | None = None) -> None:
        """In the map `kept`, or in the one that there was before; with the newest settings.

        `InputError` where that cannot be; then nothing has happened.
        """
        before, self._kept = self._kept, kept or self._kept
        try:
            pipeline = self._pipeline()
        except InputError:
            self._kept = before
            raise
        self.pipeline.close()
        self._resumed = None
        self._begin(pipeline)
        self.health.start_over()
        self._outputs.begin(self.config)
        if self._autosave:
            self._autosave.config = self.config

    def pause(self, why: str) -> None:
        """Use nothing that arrives, or, where there is no reason, what arrives from now on."""
        if self.health.why_idle and not why:
            self.pipeline.pause()
        self.health.why_idle = why

    def newest_ns(self) -> int:
        """Stamp of the newest step; 0: there was none."""
        return self.health.step.stamp_ns if self.health.step else 0

    def save_state(self) -> None:
        """Unless there is nothing new since the last one."""
        newest_ns = self.newest_ns()
        is_new = newest_ns > self._saved_ns
        if self._autosave and is_new and self._autosave.save(self.pipeline, newest_ns):
            self._saved_ns = newest_ns

    def publish_pictures(self, are_whole: bool = False) -> None:
        """Publish map, paths and particles, if there is a step since the last time."""
        step = self.health.step
        if step is None or not (self._has_news or are_whole):
            return
        self._has_news = False
        self.health.landmarks = self._outputs.pictures(step.stamp_ns, self.pipeline, are_whole)
        log = self._node.get_logger()
        log.info(self.health.progress(), throttle_duration_sec=PROGRESS_PERIOD_S)

    def publish_diagnostics(self) -> None:
        """Publish how the fusion is; tell of another one as soon as there is one."""
        found = rival(self._node, self._outputs.steps_name)
        if found and not self.health.rival:
            self._node.get_logger().error(found)
        self.health.rival = found
        for line in self._silence.news(self._published_by_others):
            self._node.get_logger().warning(line)
        statuses = self.health.statuses(
            len(self.inbox),
            self.pipeline.pending,
            self.pipeline.dropped,
            self._silence.told,
            self.pipeline.frames(),
            self.pipeline.lost(),
        )
        self._outputs.diagnostics(self._node.get_clock().now().nanoseconds, statuses)

    def _pipeline(self) -> Pipeline:
        return Pipeline(self.config, self._warn, keeps_frames=False, kept=self._kept)

    def _begin(self, pipeline: Pipeline) -> None:
        self.pipeline = pipeline
        self._rewind = Rewind(self.config.apart_ns)
        self._has_news, self._saved_ns = False, 0

    def _listen(self, topic: topics.Topic, robot: str, decode: Decode) -> topics.Topic:
        """Put what comes on a topic of `robot` into the inbox; the topic with its whole name."""
        is_odometry = topic == topics.odometry(robot)

        def keep(data: bytes) -> None:
            self.health.hear(robot)
            self._silence.hear(reader.topic_name)
            if not self.health.why_idle:
                self.inbox.put(Message(time.monotonic(), topic, decode, data, not is_odometry))

        reader = subscribe(self._node, topic, keep)
        self._readers.append(reader)
        return topic._replace(name=reader.topic_name)

    def _lose(self, message: Message) -> None:
        name = message.topic.name
        text = f"dropped a message of {name}: more wait than inbox_mb = {self._settings.inbox_mb:g}"
        self.pipeline.lose(f"inbox full: {name}", f"{text}; use fewer particles, or raise it")

    def _handle(self, message: Message) -> None:
        self.health.lag_s = time.monotonic() - message.arrived_s
        try:
            event = message.decode(message.data)
        except InputError as error:
            self.pipeline.refuse(error)
        else:
            if self._resumed:
                self._confirm(self._resumed, event)
            if self._rewind.note(event):
                self._start_over()
            else:
                self._take(event)

    def _take(self, event: Event) -> None:
        """Hand an event to the pipeline, and publish what comes of it."""
        self._publish_steps(self.pipeline.handle(event))
        prediction = self.pipeline.predict(event)
        if prediction and isinstance(event, PoseSample):
            self._outputs.prediction(prediction, event.pose)

    def _confirm(self, resumed: Resumed, event: Event) -> None:
        """Go on after a crash, if this first event comes soon enough; otherwise begin anew."""
        self._resumed = None
        late_s = (event.stamp_ns - resumed.stamp_ns) / 1e9
        if -self.config.apart_ns / 1e9 <= late_s <= self._keeping.resume_s:
            log = self._node.get_logger()
            log.info(f"going on {late_s:.1f} s after the state in the autosave")
            resumed.pipeline.pause()
        else:
            self._warn(
                f"not going on from the autosave, but beginning anew: {late_s:.1f} s have passed, "
                f"and resume_s = {self._keeping.resume_s:g}"
            )
            self.begin_anew()

    def _start_over(self) -> None:
        """End one run, and begin another with what has come of it already."""
        log = self._node.get_logger()
        log.warning("time went back: starting over with the same configuration")
        self._publish_steps(self.pipeline.finish())
        self.publish_pictures(are_whole=True)
        beginning = self._rewind.beginning()
        self.begin_anew()
        for event in beginning:
            self._rewind.note(event)
            self._take(event)

    def _publish_steps(self, steps: list[StepRecord]) -> None:
        for step in steps:
            self.health.note(step, self.pipeline.dropped.total())
        self._outputs.steps(steps, self.pipeline)
        self._has_news |= bool(steps)

    def _published_by_others(self) -> dict[str, str]:
        """The type of every topic that somebody else publishes, by whole name."""
        node, own = self._node, self._outputs.names
        known = node.get_topic_names_and_types()
        return {n: types[0] for n, types in known if n not in own and node.count_publishers(n)}

    def _warn(self, text: str) -> None:
        """Tell of a loss; of those that differ in numbers only, one in a while."""
        kind, now_s = re.sub(r"\b[\d.]+", "", text), time.monotonic()
        if now_s - self._warned_s.get(kind, -np.inf) > WARNING_PERIOD_S:
            self._warned_s[kind] = now_s
            self._node.get_logger().warning(text)
