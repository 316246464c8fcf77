"""Events in, steps out: order messages by stamp, pair them into frames, step the filter."""

from multi_robot_slam.pipeline.pipeline import Pipeline

__all__ = ["Pipeline"]
