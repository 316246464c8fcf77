"""What the benchmark measures, and the least time this machine would allow for it."""

from dataclasses import dataclass

from numba.core.dispatcher import Dispatcher

from multi_robot_slam.filter import informed_kernels, kernels
from multi_robot_slam.studies import machine
from multi_robot_slam.studies.session import Proposal

WORD = 4
"""Bytes of a float32 or int32."""

OUTCOME = 3 * WORD
"""Match, D (18) and |Z| (16)."""

BYTES: dict[Proposal, int] = {
    # planes read and written; outcome written, and read to weigh it and name the match
    "motion": (2 * kernels.PLANES * WORD) + 2 * OUTCOME,
    # planes also read to match; outcome also read to update
    "informed": (3 * kernels.PLANES * WORD) + 3 * OUTCOME,
}
"""What a particle-observation has to move; what belongs to the particle alone is not counted."""

GATHER_BYTES = 2 * kernels.PLANES * WORD
"""The same for the lazy copy after resampling: planes read and written."""

KERNELS: dict[Proposal, tuple[Dispatcher, ...]] = {
    "motion": (kernels.update,),
    "informed": (informed_kernels.believe, kernels.update),
}
"""Loops that every particle-observation goes through; their operations are counted."""


@dataclass(frozen=True)
class Sizes:
    """What is measured; the names of the rows stand for the defaults."""

    particles: int = 2000
    few_particles: int = 100
    default_particles: int = 500
    textbook_particles: int = 5
    robots: int = 3
    observations: int = 15
    landmarks: int = 700
    small_map: int = 500
    large_map: int = 10_000
    memory_map: int = 1000
    grown_map: int = 6000
    literal_map: int = 100
    """Its step takes time in proportion; a larger map would flatter the ratio."""
    steps: int = 100
    rounds: int = 3
    """Steps of the rivals, and fresh processes."""
    many_robots: int = 10
    rate_hz: float = 10.0
    """Frames of each robot in a second, where a team is live or in a bag."""
    start_s: float = 30.0
    live_s: float = 60.0
    """Of a live team: what does not count, and then what does."""
    bag_s: float = 600.0
    """Least length of a bag; it holds whole rounds of the tour."""
    seed: int = 0
    """Of the worlds and the filters; the rivals' rounds count on from it."""


QUICK = Sizes(steps=40, rounds=1, start_s=10.0, live_s=20.0, bag_s=75.0)


class Limits:
    """Least time of a particle-observation [ns]: moving its bytes or its arithmetic, the longer."""

    def __init__(self, sizes: Sizes) -> None:
        touched = sizes.robots * sizes.observations * kernels.PLANES * WORD * sizes.particles
        self.rates = machine.measure(working_set=touched)
        self.operations = {p: sum(map(machine.operations, KERNELS[p])) for p in KERNELS}
        self.gather = GATHER_BYTES * self.rates.ns_per_byte

    def proposal(self, proposal: Proposal) -> float:
        """Predict, associate, update and weigh."""
        return max(
            BYTES[proposal] * self.rates.ns_per_byte,
            self.operations[proposal] * self.rates.ns_per_operation,
        )

    def step(self, proposal: Proposal) -> float:
        """The same and the lazy copy."""
        return self.proposal(proposal) + self.gather

    def explain(self, proposal: Proposal) -> str:
        """What the limit of a proposal is made of."""
        return (
            f"{BYTES[proposal]} bytes at {1 / self.rates.ns_per_byte:.0f} GB/s, "
            f"{self.operations[proposal]} operations at "
            f"{1 / self.rates.ns_per_operation:.0f} GFLOP/s"
        )
