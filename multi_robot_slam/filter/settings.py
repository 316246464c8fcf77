"""Settings of the filter: Algorithm 1, and the return to the posterior of all paths."""

import os
from dataclasses import field
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Interval

from msg_defs.types import settings
from multi_robot_slam.models.motion import MotionSettings

LEAST_UNKNOWNS = 100
"""Fewer would not be worth a smoothing."""

WORTH_A_THREAD = 2048
"""Particles that make a second thread pay."""


@settings
class RejuvenationSettings:
    """When and how the particles return to the posterior of all paths."""

    ancestors_below: Annotated[
        float,
        Interval(ge=0, le=1),
        "rejuvenate when the particles descend from less than this share of those of the last "
        "time; 0 is never",
    ] = 0.25
    delay_s: Annotated[
        float,
        Ge(0),
        "message time from the frame at which rejuvenation begins to the first one after which it "
        "counts [s]; so long may it take beside the filter without a pause",
    ] = 0.25
    unknowns: Annotated[
        int,
        Ge(LEAST_UNKNOWNS),
        "most unknowns of poses and landmarks that are smoothed together; beyond that the older "
        "half of the poses is marginalised: the time of a rejuvenation grows with the cube",
    ] = 1800
    landmarks: Annotated[
        int,
        Ge(1),
        "most landmarks of marginalised frames; beyond that those are forgotten that have the most "
        "better ones around them: memory grows with the square, 8 MB for 500",
    ] = 1000
    least_seen: Annotated[
        int,
        Ge(1),
        "landmarks of marginalised frames that were observed less often are forgotten; more than 1 "
        "where a detector reports what it never finds again",
    ] = 1
    share: Annotated[
        float,
        Interval(gt=0, le=1),
        "smallest share of the particles with one association history that is rejuvenated; each "
        "such history is smoothed by itself",
    ] = 0.25


@settings
class ExistenceSettings:
    """Which landmarks are published: those that are likely to be there (`existence`)."""

    published_from: Annotated[
        int,
        Ge(1),
        "a landmark is published once it was observed from so many places: what a gross error made "
        "is never seen again; 1: at once",
    ] = 2
    apart_m: Annotated[
        float,
        Gt(0),
        "places of a robot are so far apart [m]; somewhat less than keyframes, for a pose is not "
        "exactly what odometry said: frames of a robot that stands are one place",
    ] = 0.2
    apart_rad: Annotated[float, Gt(0), "or turned so far [rad]"] = 0.12
    gone_below: Annotated[
        float,
        Interval(ge=0, lt=1),
        "a landmark leaves the published map when as many looks at its place in a row as last did "
        "not find it are less likely than this, by how often looks found it before; of a thousand "
        "landmarks one in ten times is out wrongly, until it is seen again; 0: never",
    ] = 1e-4

    @property
    def is_on(self) -> bool:
        """Whether any landmark may be left out."""
        return self.published_from > 1 or self.gone_below > 0


NO_REJUVENATION = RejuvenationSettings(ancestors_below=0.0)
"""The filter alone, as in the paper."""


@settings
class FilterSettings:
    """Settings of the particle filter."""

    particles: Annotated[int, Interval(ge=1, le=100_000), "number of particles M"] = 500
    gate: Annotated[
        float, Gt(0), "D_0, squared Mahalanobis distance; the 99 % quantile of chi2 with 3 dof"
    ] = 11.345
    descriptor_gate: Annotated[float, Gt(0), "E_0, squared descriptor distance"] = 0.04
    sighting_gate: Annotated[
        float, Gt(0), "of a robot seen, squared Mahalanobis distance; 99 % of chi2 with 2 dof"
    ] = 9.21
    robust_above: Annotated[
        float,
        Gt(0),
        "in smoothing, D up to which an observation or sighting counts in full; far above it is "
        "nothing; as D_0, 99 % of chi2 with 3 dof (of a sighting, with 2 dof, 99.7 %)",
    ] = 11.345
    resample_below: Annotated[
        float, Interval(ge=0, le=1), "resample below this share of M effective; 1 = every step"
    ] = 0.5
    proposal: Annotated[
        Literal["motion", "informed"], "motion: the paper's (7); informed: knows the observations"
    ] = "informed"
    exclusive: Annotated[
        bool, "whether two observations of one frame may not be the same landmark"
    ] = True
    noise_at: Annotated[
        Literal["measurement", "landmark"],
        "where the covariance of a stereo observation is taken: at the measured point, as it "
        "comes, or at the landmark that it is of, which does not depend on its own error",
    ] = "measurement"
    correlated: Annotated[
        float,
        Ge(1),
        "factor on the covariances of observations, where errors of successive ones are alike: "
        "1 + 2 sum (1 - k / n) r_k for n observations of a landmark whose errors correlate by r_k "
        "k frames apart; a camera's do, for the same texture fools it again",
    ] = 1.0
    learn_noise: Annotated[
        bool,
        "whether the noise of each robot's odometry and observations is that which rejuvenation "
        "finds, a factor of 1 or more on what was told; otherwise the factors are estimated all "
        "the same, and only told",
    ] = True
    mapping: Annotated[
        bool,
        "whether what robots see changes the map; otherwise they are only localised in the one "
        "that was loaded, nothing is learnt of odometry and noise, and nothing is rejuvenated: "
        "that needs unknown landmarks",
    ] = True
    threads: Annotated[
        int, Interval(ge=0, le=256), "threads of the filter; 0 chooses; no effect on results"
    ] = 0
    motion: MotionSettings = field(default_factory=MotionSettings)
    rejuvenation: RejuvenationSettings = field(default_factory=RejuvenationSettings)
    existence: ExistenceSettings = field(default_factory=ExistenceSettings)


def threads(settings: FilterSettings) -> int:
    """How many threads to use; the choice has no effect on results."""
    if settings.threads:
        return settings.threads
    return min(len(os.sched_getaffinity(0)), settings.particles // WORTH_A_THREAD) or 1
