"""The card of a regressor of twists: from what it was trained, how well it does joint by joint, and whom to thank."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mocapfix.files import replacing
from mocapfix.initialise.twist import Twists
from mocapfix.skeleton import average
from mocapfix.train.card import common
from mocapfix.train.mirror import mirrored_name
from mocapfix.train.poses import Poses
from mocapfix.train.settings import TwistSettings
from mocapfix.train.twist_examples import HAS

CARD = """\
# {name}

{title}

A bone's twist, its turn about itself, as HybrIK regresses it (section 3.3, Eq. 19), but from joint positions alone. Trained by
`mocapfix train twist` on {count:,} frames at about 30 Hz of {people} subjects, each also mirrored, without place and heading;
{dropped:,} frames more were left out, which lie beyond a jump of the solve that they come from.

| subjects | with their frames |
|---|---|
| learned from | {seen} |
{kept}

## Scores

Degrees between the twists of subjects it has not seen and what is said of them, mean over frames; both sides are alike, for every
pose is there mirrored, too. "Displaced" is the network where joints are up to 30 mm off along each axis and some are lost. Sigma
is by how much people are taken to stray from what it says: more than they do, so that what markers say shall stand.

| joint | no twist | mean twist | regressed | displaced | sigma |
|---|---|---|---|---|---|
{rows}

Where CMU's own skeleton lets a joint not twist at all (hip stubs, knees, clavicles, elbows) this says nothing of people. Leaves
(head, toes, fingertips, thumbs) are not regressed: no joint beyond them tells how they are turned.

## Settings

{settings}

## Data

The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217.
(That is what CMU asks for. Whoever trains on other motion should name it here.)
"""


@dataclass(frozen=True)
class Scores:
    """(B,) degrees each, for the joints that have a bone: mean error of no twist, of each joint's mean twist, and of what the
    network says from joints as they are, and from joints displaced and lost."""

    zero: np.ndarray
    mean: np.ndarray
    regressed: np.ndarray
    displaced: np.ndarray


def write(path: Path, settings: TwistSettings, network: Twists, poses: Poses, scores: Scores) -> None:
    """Write the card; into place whole or not at all. Raises WriteError."""
    shown = rows(scores, np.degrees(network.sigma[HAS]))
    text = CARD.format(**common(path.stem, settings, poses), rows="\n".join(shown))
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def rows(scores: Scores, sigma: np.ndarray) -> list[str]:
    """-> the table's rows: the joints of the left and the middle, and the mean over all."""
    columns = np.stack([*vars(scores).values(), sigma], axis=1)
    names = [name for name, has in zip(average().names, HAS, strict=True) if has]
    shown = [i for i, name in enumerate(names) if i <= names.index(mirrored_name(name))]
    means = " | ".join(f"{value:.1f}" for value in columns[:, :-1].mean(axis=0))
    return [f"| {names[i]} | " + " | ".join(f"{v:.1f}" for v in columns[i]) + " |" for i in shown] + [f"| mean | {means} | |"]
