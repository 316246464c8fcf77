"""Every field of a settings class is a ROS parameter, with its description and range."""

from collections.abc import Callable, Mapping, Sequence
from math import inf, nan
from operator import attrgetter
from typing import Any, cast, get_args, get_origin

from pydantic import TypeAdapter
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from msg_defs import limits, scenario_file
from msg_defs.errors import InputError

QOS_OVERRIDES = "qos_overrides."
"""How the names begin of parameters that change a topic's quality of service."""

_ROS_OWN = ("use_sim_time", "start_type_description_service")
_INT64_MAX = 2**63 - 1


def given(node: Node) -> dict[str, Any]:
    """The parameters that the node has, by name; before any is declared, those the user gave."""
    found = cast(Mapping[str, Parameter], node.get_parameters_by_prefix(""))
    return {name: parameter.value for name, parameter in found.items()}


def declare(
    node: Node, *classes: type, section: str | None = None, is_managed: bool = False
) -> list[Any]:
    """Declare every field of the settings `classes` as a parameter; their values.

    It is read-only unless its field is marked `limits.AT_ANY_TIME`, or the node `is_managed`: then
    `follow_changes` says which may change when.

    Nested settings get dotted names, a tuple of tuples becomes one flat array, in which a word
    instead of a row is as many NaN. With `section`, a
    parameter `scenario` names a scenario (`scenario_file.find_scenario`) whose `section` supplies
    the defaults of the first class. Unknown parameters and values out of range raise `InputError`.
    """
    values = given(node)
    defaults = [cls() for cls in classes]
    if section is not None:
        scenario = values.get("scenario", "")
        description = ParameterDescriptor(
            description="scenario, a file or a name", read_only=True, dynamic_typing=True
        )
        _declare_one(node, "scenario", scenario, description)
        if scenario:
            path = scenario_file.find_scenario(str(scenario))
            defaults[0] = scenario_file.from_file(classes[0], path, section)
    records = [_override(default, values) for default in defaults]
    for record in records:
        for leaf in limits.leaves(type(record)):
            value = _flat(leaf, attrgetter(leaf.name)(record))
            _declare_one(node, leaf.name, value, _describe(leaf, is_managed))
    _refuse_unknown(node, values)
    return records


def records(node: Node, *classes: type) -> list[Any]:
    """The values of the settings `classes` as the node's parameters are now; or `InputError`."""
    values = given(node)
    return [_override(cls(), values) for cls in classes]


def follow_changes(
    node: Node,
    classes: Sequence[type],
    is_free: Callable[[], bool],
    take: Callable[..., None],
    at_beginning: Sequence[str] = (),
) -> None:
    """Refuse changes of parameters that cannot be, with the remedy, and tell of the others.

    Parameters
    ----------
    classes : as they were declared for a managed node.
    is_free : whether the node is not configured, so that everything may change.
    take : called with the values of all classes after a change.
    at_beginning : names of what may change at any time, too, and counts from the next beginning.

    """
    leaves = {leaf.name: leaf for cls in classes for leaf in limits.leaves(cls)}

    def may(changed: list[Parameter]) -> SetParametersResult:
        try:
            for name in (one.name for one in changed):
                is_fixed = name in leaves and name not in at_beginning and _is_fixed(leaves[name])
                if is_fixed and not is_free():
                    raise InputError(_remedy(node, name))
            values = given(node) | {one.name: one.value for one in changed}
            for cls in classes:
                _override(cls(), values)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def changed(parameters: list[Parameter]) -> None:
        names = [one.name for one in parameters if one.name in leaves]
        later = [name for name in names if name in at_beginning]
        if later and not is_free():
            node.get_logger().info(f"{', '.join(later)}: counts when it begins anew, as by ~/reset")
        if names:
            take(*records(node, *classes))

    node.add_on_set_parameters_callback(may)
    node.add_post_set_parameters_callback(changed)


def _is_fixed(leaf: limits.Field) -> bool:
    return limits.AT_ANY_TIME not in leaf.metadata


def _remedy(node: Node, name: str) -> str:
    calls = f"ros2 lifecycle set {node.get_fully_qualified_name()}"
    return (
        f"{name} cannot change while the node is configured: {calls} deactivate, then cleanup, "
        "which ends the run (~/save_map keeps its map); set it; then configure and activate"
    )


def _override(default: Any, values: Mapping[str, Any]) -> Any:
    """`default` with the given parameters in place of its own values."""
    plain = TypeAdapter(type(default)).dump_python(default)
    for leaf in limits.leaves(type(default)):
        if leaf.name in values:
            *parents, key = leaf.name.split(".")
            inner = plain
            for parent in parents:
                inner = inner[parent]
            inner[key] = _unflat(leaf, values[leaf.name])
    return scenario_file.from_mapping(type(default), plain, "parameter")


def _row_size(kind: Any) -> int:
    """Length of the inner tuples of a tuple of tuples, else 0."""
    inner = get_args(kind)[:1]
    if inner and (either := limits.row_or_word(inner[0])):
        return either[0]
    return len(get_args(inner[0])) if inner and get_origin(inner[0]) is tuple else 0


def _flat(leaf: limits.Field, value: Any) -> Any:
    if not isinstance(value, tuple):
        return value
    if either := _row_or_word(leaf):
        size, word = either
        value = tuple((nan,) * size if row == word else row for row in value)
    rows = [row if isinstance(row, tuple) else (row,) for row in value]
    return [element for row in rows for element in row]


def _unflat(leaf: limits.Field, value: Any) -> Any:
    size = _row_size(leaf.kind)
    if not isinstance(value, str | bytes) and hasattr(value, "__len__"):
        value = list(value)
    if not size or not isinstance(value, list):
        return value
    if len(value) % size:
        raise InputError(f"parameter: {leaf.name}: {len(value)} numbers do not make rows of {size}")
    rows: list[Any] = [value[i : i + size] for i in range(0, len(value), size)]
    if either := _row_or_word(leaf):
        rows = [either[1] if all(x != x for x in row) else row for row in rows]
    return rows


def _row_or_word(leaf: limits.Field) -> tuple[int, str] | None:
    """`limits.row_or_word` of the elements of a tuple."""
    return limits.row_or_word(next(iter(get_args(leaf.kind)), None))


def _declare_one(node: Node, name: str, value: Any, descriptor: ParameterDescriptor) -> None:
    if node.has_parameter(name):
        node.undeclare_parameter(name)
    node.declare_parameter(name, value, descriptor, ignore_override=True)


def _describe(leaf: limits.Field, is_managed: bool) -> ParameterDescriptor:
    """Description, unit and closed range; `from_mapping` has checked the open bounds already."""
    is_fixed = _is_fixed(leaf)
    descriptor = ParameterDescriptor(
        description=leaf.description,
        read_only=is_fixed and not is_managed,
        dynamic_typing=is_fixed,
    )
    bounds = limits.bounds_of(leaf.metadata)
    low = bounds.gt if bounds.ge is None else bounds.ge
    high = bounds.lt if bounds.le is None else bounds.le
    if low is None and high is None:
        return descriptor
    if leaf.kind is float:
        low = -inf if low is None else float(low)
        high = inf if high is None else float(high)
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    if leaf.kind is int:
        low = -_INT64_MAX if low is None else int(low)
        high = _INT64_MAX if high is None else int(high)
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
    return descriptor


def _refuse_unknown(node: Node, names: Mapping[str, Any]) -> None:
    for name in names:
        is_ros_own = name in _ROS_OWN or name.startswith(QOS_OVERRIDES)
        if not is_ros_own and not node.describe_parameter(name).description:
            raise InputError(
                f"unknown parameter '{name}' of node {node.get_name()}; "
                "remove it or correct its spelling"
            )
