"""Settings of the rendered cameras: what the walls show, and what spoils a picture."""

from dataclasses import field
from typing import Annotated, Literal

from annotated_types import Ge, Interval

from msg_defs.types import settings


@settings
class WallSettings:
    """What is on the walls; it depends on the scenario's `world_seed` alone."""

    posters_per_m: Annotated[
        float, Ge(0), "posters, doors, shelves and the like on a metre of wall, where they fit"
    ] = 0.5
    repeated: Annotated[
        float,
        Interval(ge=0, le=1),
        "share of them that are copies of a few, so that places look alike; realistic: 0.2",
    ] = 0.0
    designs: Annotated[int, Ge(1), "how many different ones the copies are of"] = 4
    plain: Annotated[
        float,
        Interval(ge=0, le=1),
        "share of the walls' length in stretches where there is nothing to see; realistic: 0.3",
    ] = 0.0


@settings
class ImageSettings:
    """Rendered pictures of the stereo camera, and their defects; without any, they are perfect."""

    enabled: Annotated[
        bool, "robots publish pictures, of which the node `camera` makes landmarks"
    ] = False
    transport: Annotated[
        Literal["auto", "raw", "png", "jpeg"],
        "how messages hold them; auto: raw on topics, png, of the same pixels, in bags",
    ] = "auto"
    jpeg_quality: Annotated[int, Interval(ge=1, le=100), "of jpeg; 100 is the best"] = 95
    walls: WallSettings = field(default_factory=WallSettings)
    blur_px: Annotated[
        float, Interval(ge=0, le=10), "standard deviation of the lens's blur [px]; realistic: 0.5"
    ] = 0.5
    exposure_drift: Annotated[
        float,
        Interval(ge=0, le=2),
        "greatest change of both cameras' exposure over time, as a logarithm; realistic: 0.2",
    ] = 0.0
    gain_difference: Annotated[
        float,
        Interval(ge=0, le=2),
        "greatest difference of the right camera's gain from the left's, as a logarithm; "
        "realistic: 0.1",
    ] = 0.0
    vignetting: Annotated[
        float, Interval(ge=0, le=1), "share of the light lost in the corners; realistic: 0.3"
    ] = 0.0
    photon_noise: Annotated[
        float, Ge(0), "standard deviation of white pixels [grey values]; realistic: 2.5"
    ] = 0.0
    read_noise: Annotated[
        float, Ge(0), "standard deviation of black pixels [grey values]; realistic: 1.5"
    ] = 0.0
    exposure_s: Annotated[
        float, Interval(ge=0, le=1), "how long a picture is exposed [s]; realistic: 0.01"
    ] = 0.0
    people: Annotated[
        int, Interval(ge=0, le=200), "people who walk through the building; realistic: 8"
    ] = 0
    right_off_px: Annotated[
        tuple[float, float],
        "column and row by which the right picture is off its calibration [px]; realistic: 0.1 0.3",
    ] = (0.0, 0.0)
