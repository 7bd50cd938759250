"""Plausible sizes of robots: lengths far outside of their ranges are probably in millimetres."""

from collections.abc import Iterator

import numpy as np

from cnpgen.robots.robot import Robot


def find_implausible_sizes(robot: Robot) -> Iterator[str]:
    yield from ()
