"""A model's card: from what it was trained, how well it does, and whom to thank."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mocapfix.files import replacing
from mocapfix.prior.contract import PoseModel
from mocapfix.train.poses import Poses
from mocapfix.train.settings import Settings, TwistSettings

CARD = """\
# {name}

{title}

Trained by `mocapfix train prior` on {count:,} frames at about 30 Hz of {people} subjects, each also mirrored, without place and
heading; {dropped:,} frames more were left out, which lie beyond a jump of the solve that they come from.

| subjects | with their frames |
|---|---|
| learned from | {seen} |
{kept}

## Scores

A pose encoded and decoded again, mean over frames and all joints but the root:

| | degrees |
|---|---|
| {whom} learned from | {seen_deg:.2f} |
| {whom} it has not seen | {unseen_deg:.2f} |

A code is {size} numbers; those of the unseen {whom} deviate by {spread:.2f} (root mean square) of what the model takes for one.
Sigma, by which a person's pose lies about the decoded one, is {low:.1f} to {high:.1f} degrees per axis, its median {median:.1f}.

A better reconstruction is not a better prior: choose by what it does in the solve.

## Settings

{settings}
{told}
## Data

The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217.
(That is what CMU asks for. Whoever trains on other motion should name it here.)
"""


@dataclass(frozen=True)
class Scores:
    """Degrees between poses and what the model makes of them, mean over joints, of seen and of unseen subjects; and the root
    mean square of the unseen subjects' codes."""

    seen: float
    unseen: float
    spread: float


def write(path: Path, settings: Settings, model: PoseModel, poses: Poses, scores: Scores, told: str) -> None:
    """Write the card; into place whole or not at all; `told` is what more there is to say of the fit. Raises WriteError."""
    low, median, high = np.degrees(np.percentile(model.sigma[1:], [0, 50, 100]))
    text = CARD.format(
        **common(path.stem, settings, poses),
        whom="frames" if poses.interleaved else "subjects",
        seen_deg=scores.seen,
        unseen_deg=scores.unseen,
        size=model.size,
        spread=scores.spread,
        low=low,
        median=median,
        high=high,
        told=f"\n{told}\n" if told else "",
    )
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def common(name: str, settings: Settings | TwistSettings, poses: Poses) -> dict[str, object]:
    """-> what every card tells, by its names there: what the model is called, from whom it has learned, its settings."""
    said = settings.model_dump(exclude={"title", "test", "unseen"})
    learned = {who: frames for who, frames in poses.frames.items() if poses.interleaved or who not in settings.unseen}
    return {
        "name": name,
        "title": settings.title,
        "count": sum(learned.values()),
        "people": len(learned),
        "dropped": poses.dropped,
        "seen": listed(learned),
        "kept": kept(settings, poses),
        "settings": "\n".join(f"- {key}: {value}" for key, value in said.items()),
    }


def kept(settings: Settings | TwistSettings, poses: Poses) -> str:
    """-> the card's rows on whom the model has not learned from."""
    if poses.interleaved:
        return "| kept from it, for the scores and the benchmark | two frames of every five, between those learned from |"
    unseen = listed({who: frames for who, frames in poses.frames.items() if who in settings.unseen})
    test = ", ".join(sorted(settings.test))
    return f"| kept from it, for sigma and the scores | {unseen} |\n| never read, for the benchmarks | {test} |"


def listed(frames: dict[str, int]) -> str:
    """-> subjects, each with how many frames are his."""
    return ", ".join(f"{who} ({count:,})" for who, count in sorted(frames.items()))
