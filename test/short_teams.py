"""Two robots in their first seconds, as `study hard` has them, and what a fusion makes of them."""

from dataclasses import replace

from multi_robot_slam import runs
from multi_robot_slam.pipeline import offline
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.studies import accuracy, hard_worlds


def told(particles, end_s):
    """What a team sends in its first `end_s` in the exact world, and a fusion is told."""
    base = accuracy.calibrated()
    own = replace(base.filters["rejuvenated"], particles=particles)
    base = replace(base, filters=base.filters | {"rejuvenated": own})
    whole = hard_worlds.simulated(base, "exact", 2, 0)
    first_ns = min(event.stamp_ns for event in whole.events)
    events = tuple(e for e in whole.events if e.stamp_ns - first_ns <= end_s * 1e9)
    return replace(whole, events=events)


class Ran:
    """The run of a fusion, its pipeline, its steps, and the lines it said."""

    def __init__(self, told):
        self.lines = []
        self.pipeline = Pipeline(told.config, self.lines.append)
        predictions = runs.Predictions()
        self.steps = offline.run_through(self.pipeline, told.events, on_prediction=predictions.add)
        self.run = offline.assemble(self.pipeline, told.recorded, self.steps, predictions)
        self.pipeline.close()

    def levels(self, robot):
        """(stamp, level) of each verdict on a robot."""
        return [(s.stamp_ns, v.level) for s in self.steps for v in s.verdicts if v.robot == robot]
