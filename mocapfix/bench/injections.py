"""Faults as stages have them, put into sound takes: how often, how long and how bad each kind is.

All is drawn. Lengths and sizes are spread evenly over their logarithm, for short and small faults are many and long and large
ones few; places are drawn alike from all markers and frames that nothing has happened to, markers that are exchanged from
the three nearest. Nothing here is made easy: a knock may be no larger than what skin does on lively people, an exchange may
begin while its markers are hidden and so without a leap. Only where a marker rests nothing is held or drawn straight, for
there it makes no difference.
"""

from collections.abc import Callable
from functools import partial

from mocapfix.bench.injected_labels import exchange, fragment, mirrored, mislabelled
from mocapfix.bench.injected_moves import move
from mocapfix.bench.injected_samples import gap, ghost, jitter, spike, straight, stuck
from mocapfix.bench.stage import Place, Stage

RESTS = 0.01  # metres: what goes less far meanwhile is at rest


def often(
    what: Callable[[Stage, Place], None],
    each_minute: float,
    seconds: tuple[float, float],
    together: int = 1,
    moving: float = 0.0,
) -> Callable[[Stage], None]:
    """-> what lets it happen so often a minute, for so many seconds each time (see Stage.place)."""

    def happens(stage: Stage) -> None:
        for _ in range(round(each_minute * stage.frames / stage.rate / 60)):
            if place := stage.place(seconds, together, moving):
                what(stage, place)

    return happens


def twice(what: Callable[[Stage], None]) -> Callable[[Stage], None]:
    def happens(stage: Stage) -> None:
        what(stage)
        what(stage)

    return happens


INJECTIONS: dict[str, Callable[[Stage], None]] = {
    "gap": often(gap, 60, (0.03, 4.0)),
    "flicker": often(gap, 90, (0.008, 0.017)),
    "spike": often(spike, 90, (0.008, 0.025)),
    "jitter": often(jitter, 18, (0.2, 1.0)),
    "stuck": often(stuck, 24, (0.1, 2.0), moving=RESTS),
    "straight": often(straight, 24, (0.1, 2.0), moving=RESTS),
    "swap": often(exchange, 12, (0.2, 3.0), together=2),
    "ring": often(exchange, 9, (0.2, 3.0), together=3),
    "ghost": often(ghost, 18, (0.1, 2.0)),
    "fragment": often(fragment, 18, (0.2, 3.0)),
    "moved": twice(partial(move, kind="moved", begins=(0.2, 0.8), lasts=(0.0, 0.0))),
    "drift": twice(partial(move, kind="drift", begins=(0.1, 0.35), lasts=(0.3, 0.45))),
    "mislabelled": mislabelled,
    "mirrored": mirrored,
}
