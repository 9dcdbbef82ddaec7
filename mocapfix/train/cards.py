"""A model's card: from what it was trained, how well it does, and whom to thank."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mocapfix.files.output_files import replace_atomically
from mocapfix.initialise.twist_regressor import TwistRegressor
from mocapfix.pose_prior.model import PoseModel
from mocapfix.skeleton import load_cmu31_skeleton
from mocapfix.train.settings import PriorSettings, TwistSettings
from mocapfix.train.training_poses import TrainingPoses, mirror_joint_name
from mocapfix.train.twist_examples import HAS_TWIST

# MERGED: mocapfix.train.card
PRIOR_CARD = """\
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
class PriorScores:
    """Degrees between poses and what the model makes of them, mean over joints, of seen and of unseen subjects; and the root
    mean square of the unseen subjects' codes."""

    training_deg: float
    held_out_deg: float
    code_rms: float


def write_prior_card(
    path: Path, settings: PriorSettings, model: PoseModel, poses: TrainingPoses, scores: PriorScores, fit_summary: str
) -> None:
    """Write the card; into place whole or not at all; `told` is what more there is to say of the fit. Raises WriteError."""
    low, median, high = np.degrees(np.percentile(model.residual_sd_rad[1:], [0, 50, 100]))
    text = PRIOR_CARD.format(
        **build_common_fields(path.stem, settings, poses),
        whom="frames" if poses.is_interleaved else "subjects",
        seen_deg=scores.training_deg,
        unseen_deg=scores.held_out_deg,
        size=model.code_size,
        spread=scores.code_rms,
        low=low,
        median=median,
        high=high,
        told=f"\n{fit_summary}\n" if fit_summary else "",
    )
    with replace_atomically(path) as part:
        part.write_text(text, encoding="utf-8")


def build_common_fields(name: str, settings: PriorSettings | TwistSettings, poses: TrainingPoses) -> dict[str, object]:
    """-> what every card tells, by its names there: what the model is called, from whom it has learned, its settings."""
    said = settings.model_dump(exclude={"title", "test", "unseen"})
    learned = {
        who: frames for who, frames in poses.frame_counts.items() if poses.is_interleaved or who not in settings.held_out_subjects
    }
    return {
        "name": name,
        "title": settings.title,
        "count": sum(learned.values()),
        "people": len(learned),
        "dropped": poses.dropped_frames,
        "seen": format_frame_counts(learned),
        "kept": format_held_out_rows(settings, poses),
        "settings": "\n".join(f"- {key}: {value}" for key, value in said.items()),
    }


def format_held_out_rows(settings: PriorSettings | TwistSettings, poses: TrainingPoses) -> str:
    """-> the card's rows on whom the model has not learned from."""
    if poses.is_interleaved:
        return "| kept from it, for the scores and the benchmark | two frames of every five, between those learned from |"
    unseen = format_frame_counts({who: frames for who, frames in poses.frame_counts.items() if who in settings.held_out_subjects})
    test = ", ".join(sorted(settings.test_subjects))
    return f"| kept from it, for sigma and the scores | {unseen} |\n| never read, for the benchmarks | {test} |"


def format_frame_counts(frames: dict[str, int]) -> str:
    """-> subjects, each with how many frames are his."""
    return ", ".join(f"{who} ({count:,})" for who, count in sorted(frames.items()))


# MERGED: mocapfix.train.twist_card
# The card of a regressor of twists: from what it was trained, how well it does joint by joint, and whom to thank.
TWIST_CARD = """\
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
class TwistScores:
    """(B,) degrees each, for the joints that have a bone: mean error of no twist, of each joint's mean twist, and of what the
    network says from joints as they are, and from joints displaced and lost."""

    no_twist_deg: np.ndarray
    mean_twist_deg: np.ndarray
    regressed_deg: np.ndarray
    displaced_deg: np.ndarray


def write_twist_card(
    path: Path, settings: TwistSettings, network: TwistRegressor, poses: TrainingPoses, scores: TwistScores
) -> None:
    """Write the card; into place whole or not at all. Raises WriteError."""
    shown = format_twist_rows(scores, np.degrees(network.sd_rad[HAS_TWIST]))
    text = TWIST_CARD.format(**build_common_fields(path.stem, settings, poses), rows="\n".join(shown))
    with replace_atomically(path) as part:
        part.write_text(text, encoding="utf-8")


def format_twist_rows(scores: TwistScores, sd_deg: np.ndarray) -> list[str]:
    """-> the table's rows: the joints of the left and the middle, and the mean over all."""
    columns = np.stack([*vars(scores).values(), sd_deg], axis=1)
    names = [name for name, has in zip(load_cmu31_skeleton().names, HAS_TWIST, strict=True) if has]
    shown = [i for i, name in enumerate(names) if i <= names.index(mirror_joint_name(name))]
    means = " | ".join(f"{value:.1f}" for value in columns[:, :-1].mean(axis=0))
    return [f"| {names[i]} | " + " | ".join(f"{v:.1f}" for v in columns[i]) + " |" for i in shown] + [f"| mean | {means} | |"]
