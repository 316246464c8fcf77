"""ROS: odometry and observations of the team in, poses and the landmark map out.

A managed node, as Nav2's are: *configure* loads the filter and listens, *activate* filters what
arrives from then on, *deactivate* does not, *cleanup* ends the run. With `autostart` it configures
and activates itself.
"""

import sys
from collections.abc import Callable
from typing import Annotated, TypeVar

from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleNodeMixin
from rclpy.timer import Timer
from std_srvs.srv import SetBool, Trigger

from msg_defs.errors import InputError
from msg_defs.ros import environment
from msg_defs.ros.parameters import declare, follow_changes, records
from msg_defs.ros.spin import SPIN_TIMEOUT_S, EdgeNode, spin
from msg_defs.ros.usage import Usage
from msg_defs.types import settings
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.nodes.fusing import Fusing, Publishing
from multi_robot_slam.nodes.keeping import Keeping, loaded, save

Answer = TypeVar("Answer", Trigger.Response, SetBool.Response)
SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE

AT_BEGINNING = ("filter.mapping", "filter.learn_noise")
"""Parameters that count when it begins anew: in mid-run a recording would not tell of them."""

DIAGNOSTICS_PERIOD_S = 1.0
INACTIVE, PAUSED = "inactive", "paused"
"""Why nothing that arrives is used."""


@settings
class Life:
    """How the node begins."""

    autostart: Annotated[
        bool, "configure and activate by itself; otherwise whoever manages nodes does"
    ] = True


USAGE = Usage(
    "multi_robot_slam fusion",
    "Estimate one landmark map and all robots' paths from the team's odometry and observations. "
    "/diagnostics says of each robot whether it is consistent, noisier than told, started wrong, "
    "or lost, with cause, numbers and remedy; docs/monitor.md has how to read it. Services: "
    "~/save_map and ~/load_map (std_srvs/Trigger) write and load the files that the parameters "
    "map_out and map name; ~/reset (Trigger) begins anew; ~/pause (SetBool) uses nothing that "
    "arrives. A managed node: configure, activate, deactivate and cleanup, by itself with "
    "autostart. Parameters are changed after cleanup, some at any time.",
    (Config, Publishing, Keeping, Life),
    SECTION,
)


class Fusion(LifecycleNodeMixin, EdgeNode):
    """The node: its states, its services and its parameters; what it does is `Fusing`'s."""

    def __init__(self) -> None:
        EdgeNode.__init__(self, "fusion")
        *_, life = declare(self, *USAGE.classes, section=USAGE.section, is_managed=True)
        LifecycleNodeMixin.__init__(self)
        self.fusing: Fusing | None = None
        """Between configure and cleanup."""
        self._is_active = False
        self._periodic: list[Timer] = []
        self._refused: Exception | None = None
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._change_if_possible
        follow_changes(self, USAGE.classes, lambda: self.fusing is None, self._take, AT_BEGINNING)
        self.create_service(Trigger, "~/save_map", self._save_map)
        self.create_service(Trigger, "~/load_map", self._load_map)
        self.create_service(Trigger, "~/reset", self._reset)
        self.create_service(SetBool, "~/pause", self._pause)
        if life.autostart:
            self.trigger_configure()
            if self._refused is not None:
                raise self._refused
            self.trigger_activate()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the filter and the map, and listen."""
        self._refused = None
        try:
            config, publishing, keeping, _ = records(self, *USAGE.classes)
            self.fusing = Fusing(self, config, publishing, keeping)
        except Exception as error:  # rclpy would say nothing of it
            self._refused = error
            self.get_logger().error(f"not configured: {error}")
            return FAILURE
        self.fusing.pause(INACTIVE)
        self._set_timers(self.fusing, publishing, keeping)
        return SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Filter what arrives from now on; what came before is a gap, where there was a before."""
        fusing = self._configured()
        fusing.pause("")
        self._is_active = True
        names = ", ".join(fusing.config.robots)
        self.get_logger().info(f"ready for {names}; {environment.reach()}")
        return SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Use nothing that arrives; what waits is filtered once it is active again."""
        self._configured().pause(INACTIVE)
        self._is_active = False
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End the run, publish the last of it, and let go of all topics."""
        self._end(is_in_order=True)
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End."""
        self._is_active, self.done = False, True
        return SUCCESS

    def work(self) -> float:
        """What `Fusing` has to do."""
        return self.fusing.work() if self.fusing and self._is_active else SPIN_TIMEOUT_S

    def close(self) -> None:
        """Publish the final paths, map and counts; what it ends by an exception is gone on from."""
        if self.fusing is not None:
            self.fusing.close(is_in_order=sys.exception() is None)

    def _change_if_possible(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        """What rclpy does; but a transition that there is not would end its executor."""
        try:
            return self._change_state(request, response)
        except RuntimeError as error:
            self.get_logger().warning(f"no such transition now: {error}")
            response.success = False
            return response

    def _end(self, is_in_order: bool) -> None:
        fusing = self._configured()
        fusing.close(is_in_order)
        self._stop_timers()
        fusing.release()
        self.fusing = None

    def _configured(self) -> Fusing:
        if self.fusing is None:
            raise InputError(f"not configured: ros2 lifecycle set {self._whole_name()} configure")
        return self.fusing

    def _whole_name(self) -> str:
        return str(self.get_fully_qualified_name())

    def _set_timers(self, fusing: Fusing, publishing: Publishing, keeping: Keeping) -> None:
        self._stop_timers()
        self._periodic = [
            self.create_timer(publishing.picture_period_s, fusing.publish_pictures),
            self.every(DIAGNOSTICS_PERIOD_S, fusing.publish_diagnostics),
        ]
        if keeping.autosave and keeping.autosave_s:
            self._periodic.append(self.every(keeping.autosave_s, fusing.save_state))

    def _stop_timers(self) -> None:
        for timer in self._periodic:
            self.destroy_timer(timer)
        self._periodic = []

    def _take(self, config: Config, publishing: Publishing, keeping: Keeping, _: Life) -> None:
        """Go on with parameters that have changed."""
        if self.fusing is not None:
            self.fusing.take(config, publishing, keeping)
            self._set_timers(self.fusing, publishing, keeping)

    def _save_map(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def done() -> str:
            fusing, file = self._configured(), str(self.get_parameter("map_out").value)
            return save(file, fusing.config, fusing.pipeline, fusing.newest_ns())

        return self._answered(response, done)

    def _load_map(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def done() -> str:
            fusing, file = self._configured(), str(self.get_parameter("map").value)
            kept = loaded(file, fusing.config)
            if kept is None:
                raise InputError(f"map is empty; ros2 param set {self._whole_name()} map FILE")
            fusing.begin_anew(kept)
            return f"begun anew in {file} with {int(kept.published.sum())} landmarks"

        return self._answered(response, done)

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def done() -> str:
            self._configured().begin_anew()
            return "begun anew"

        return self._answered(response, done)

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        def done() -> str:
            if not self._is_active:
                raise InputError(
                    f"not active: ros2 lifecycle set {self._whole_name()} activate; then pause"
                )
            self._configured().pause(PAUSED if request.data else "")
            return "paused" if request.data else "going on"

        return self._answered(response, done)

    def _answered(self, response: Answer, done: Callable[[], str]) -> Answer:
        """The answer of a service: what was done, or why it could not be."""
        try:
            response.success, response.message = True, done()
            self.get_logger().info(response.message)
        except InputError as error:
            response.success, response.message = False, str(error)
            self.get_logger().warning(response.message)
        return response


def main(args: list[str] | None = None) -> int:
    """Run the fusion until interrupted; the exit code."""
    return spin(Fusion, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
