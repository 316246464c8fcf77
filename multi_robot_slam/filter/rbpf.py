"""Placeholder while the filter is written."""

from typing import Annotated

from annotated_types import Interval

from msg_defs.types import settings


@settings
class FilterSettings:
    """Settings of the particle filter."""

    particles: Annotated[int, Interval(ge=1, le=100_000), "number of particles M"] = 500
