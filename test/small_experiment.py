"""An experiment of seconds: python small_experiment.py FOLDER [SCHEDULER]."""

import sys
import time
from dataclasses import replace
from pathlib import Path

from multi_robot_slam.studies import experiment_grid, experiment_table, experiments, scheduling

JOB_S = 0.2
"""At least so long takes a job of the command."""


def base():
    """The paper's settings, but 30 movements for the whole exploration."""
    paper = experiment_grid.paper()
    return replace(paper, scenario=replace(paper.scenario, movements=30))


def wanted(seeds=range(4)):
    grid = experiment_grid.Grid(particles=(1, 5), observations=(0, 5))
    return experiment_grid.plan(("fig5",), grid, seeds, base())


def serially(function, jobs):
    return ((job, function(job)) for job in jobs)


def untimed(path):
    """The table at `path` with its timing blanked."""
    rows = experiment_table.opened(path).rows
    return [
        experiment_table.to_line(key, row | {experiment_table.TIMING: None})
        for key, row in rows.items()
    ]


def slowly(job):
    time.sleep(JOB_S)
    return experiments.compute(job)


def main(folder, scheduler=None):
    def execute(_, jobs):
        if scheduler:
            return scheduling.on_cluster(slowly, jobs, scheduler)
        return scheduling.local(slowly, jobs, processes=2)

    experiments.run(wanted(), base(), Path(folder), execute)


if __name__ == "__main__":
    main(*sys.argv[1:])
