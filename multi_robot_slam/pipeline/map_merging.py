"""Two map files of two teams -> one, or why not."""

from typing import Any, NamedTuple

from msg_defs import scenario_file
from msg_defs.errors import InputError
from multi_robot_slam.config import MOST_ROBOTS, SECTION, Config
from multi_robot_slam.filter import merging, vote
from multi_robot_slam.filter.kept import KeptMap
from multi_robot_slam.filter.merging import Merged
from multi_robot_slam.filter.vote import FALSE_RATE, Vote
from multi_robot_slam.pipeline import map_files
from multi_robot_slam.pipeline.map_files import MapFile
from multi_robot_slam.runs import provenance


class MergedFile(NamedTuple):
    """What is written of two maps."""

    about: dict[str, Any]
    kept: KeptMap
    merged: Merged | None
    """None: both are the same map."""
    vote: Vote | None


def merge(one: MapFile, other: MapFile) -> MergedFile:
    """Both maps as one, in the frame of the first, by the settings of the first.

    Robots are united by name: one that is in both maps is the same. `InputError` where no pose of
    the second in the first is believed, and where both go back to the same observations,
    which would count twice.
    """
    names = list(dict.fromkeys([*one.about["robots"], *other.about["robots"]]))
    if len(names) > MOST_ROBOTS:
        raise InputError(
            f"the maps have {len(names)} robots together, and {MOST_ROBOTS} can be told apart; "
            "give robots that are the same the same name"
        )
    first, second = (map_files.for_team(file, names) for file in (one, other))
    stamp_ns = max(one.about["stamp_ns"], other.about["stamp_ns"])
    about = one.about | {"robots": names, "stamp_ns": stamp_ns, "program": provenance.version()}
    if merging.is_same(first, second):
        return MergedFile(about, first, None, None)
    if shared := merging.count_shared(first, second):
        raise InputError(
            f"{shared} landmarks of both come from the same observations, of one recording or of "
            "one map that both began with, which would count twice; go on in one of the two with "
            "what the other's team recorded since: run BAG --map FILE"
        )
    settings = scenario_file.from_yaml(Config, one.about["config"], SECTION, "first map").filter
    pairs = vote.pairs_alike(first.descriptors, second.descriptors, settings.descriptor_gate)
    found = merging.voted(first, second, pairs)
    if found is None or not found.is_believed:
        raise InputError(_refusal(len(pairs), found))
    result = merging.merged(first, second, found, pairs, settings)
    return MergedFile(about, result.kept, result, found)


def _refusal(alike: int, found: Vote | None) -> str:
    """Why no pose is believed, with the numbers."""
    if found is None:
        why = f"{alike} pairs of landmarks look alike, and no two of them agree on a pose"
    else:
        where = ", ".join(f"{value:.2f}" for value in found.pose.tolist())
        why = (
            f"of {alike} pairs of landmarks that look alike {len(found.pairs)}, in {found.things} "
            f"places, agree that the second map lies at [{where}] in the first, and "
            f"{found.runner_up} places on another pose; by chance {found.chance:.1g} poses are so "
            f"good, and at most {FALSE_RATE:g} may be"
        )
    return f"not merged: {why}. Have robots of both teams see some six places that are the same"
