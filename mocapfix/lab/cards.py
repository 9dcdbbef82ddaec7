"""Model cards: the training data, scores, settings and acknowledgements of a pose prior or the twist regressor."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mocapfix.io.files import replace_atomically
from mocapfix.lab.frame_pairs import HAS_TWIST
from mocapfix.lab.recordings import RecordingSource
from mocapfix.lab.settings import PriorSettings, TwistSettings
from mocapfix.lab.training_poses import TrainingPoses, mirror_joint_name
from mocapfix.model.skeleton import load_cmu31_skeleton
from mocapfix.solve.hybrik import TwistRegressor
from mocapfix.solve.pose_prior import PoseModel

ACKNOWLEDGEMENT = """\
The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217.
(CMU asks for this acknowledgement. If you train on other motion, name its source here.)
"""
MOVEMENT_RESEARCH_LAB = "snumrl/"  # how the names of its repositories begin
MOVEMENT_RESEARCH_LAB_ACKNOWLEDGEMENT = """
Motion data of the Movement Research Lab, Seoul National University, from the repositories above, under Apache License 2.0
(TillingPatch, VSports, ys2010, InteractiveAnimation), MIT License (DataDrivenBipedController, copyright 2013 Yoonsang Lee) and
BSD 3-Clause License (TimeCriticalResponse, copyright 2020 NCSOFT Corporation and SNU R&D Foundation). It was transferred to
CMU's skeleton{conventions}.
"""
CONFORMED_POSES = ", and its joints were brought into CMU's conventions as `mocapfix.lab.training_poses` describes"
PRIOR_CARD = """\
# {name}

{title}

Trained by `mocapfix train prior` on {frame_count:,} frames at about 30 Hz of {subject_count} subjects, each also mirrored,
without position and heading. {dropped_frames:,} more frames, beyond a jump in the solved motion, were not used.

| subjects | with their frames |
|---|---|
| trained on | {trained_on} |
{held_out}

## Scores

Error of a pose that is encoded and decoded, mean over frames and all joints except the root:

| | degrees |
|---|---|
| {group} trained on | {training_deg:.2f} |
| held-out {group} | {held_out_deg:.2f} |

A code has {code_size} dimensions; the root mean square of the codes of held-out {group} is {code_rms:.2f}, where the model
assumes 1. The standard deviation of a pose around the decoded pose is {low:.1f} to {high:.1f} degrees per axis, its median
{median:.1f}.

A better reconstruction does not make a better prior: choose a prior by its results in the solver.

## Settings

{settings}
{fit_summary}
## Data

{sources}{acknowledgement}"""
TWIST_CARD = """\
# {name}

{title}

The twist of a bone is its rotation about itself. HybrIK regresses it from images (section 3.3, Eq. 19), this network from joint
positions alone. Trained by `mocapfix train twist` on {frame_count:,} frames at about 30 Hz of {subject_count} subjects, each
also mirrored, without position and heading. {dropped_frames:,} more frames, beyond a jump in the solved motion, were not used.

| subjects | with their frames |
|---|---|
| trained on | {trained_on} |
{held_out}

## Scores

Error of the predicted twists of held-out subjects in degrees, mean over frames; equal for both sides, because every pose is also
mirrored. For "displaced", joints are up to 30 mm off along each axis and some are missing. "SD" is the standard deviation that
the solver assumes: larger than the error, so that markers outweigh the prediction.

| joint | no twist | mean twist | regressed | displaced | SD |
|---|---|---|---|---|---|
{rows}

Joints that cannot twist in CMU's skeleton (hip stubs, knees, clavicles, elbows) show no error here, though real ones twist. Leaf
joints (head, toes, fingertips, thumbs) are not regressed, because no joint beyond them shows their rotation.

## Settings

{settings}

## Data

{sources}{acknowledgement}"""


@dataclass(frozen=True)
class PriorScores:
    """The accuracy of a pose prior.

    training_deg, held_out_deg  degrees: mean reconstruction error of training and held-out poses over all joints except the root
    code_rms                    root mean square of the codes of held-out poses
    """

    training_deg: float
    held_out_deg: float
    code_rms: float


@dataclass(frozen=True)
class TwistScores:
    """(B,) degrees: mean error of each joint's twist.

    no_twist_deg    of no twist
    mean_twist_deg  of the mean twist of the training poses
    regressed_deg   of the prediction from true joint positions
    displaced_deg   of the prediction from displaced joints, some of them missing
    """

    no_twist_deg: np.ndarray
    mean_twist_deg: np.ndarray
    regressed_deg: np.ndarray
    displaced_deg: np.ndarray


def write_prior_card(
    path: Path, settings: PriorSettings, model: PoseModel, poses: TrainingPoses, scores: PriorScores, fit_summary: str
) -> None:
    """Write the card of a pose prior, replacing the file atomically. Raises WriteError if it cannot be written."""
    low, median, high = np.degrees(np.percentile(model.residual_sd_rad[1:], [0, 50, 100]))
    text = PRIOR_CARD.format(
        **build_common_fields(path.stem, settings, poses),
        group="frames" if poses.is_interleaved else "subjects",
        training_deg=scores.training_deg,
        held_out_deg=scores.held_out_deg,
        code_size=model.code_size,
        code_rms=scores.code_rms,
        low=low,
        median=median,
        high=high,
        fit_summary=f"\n{fit_summary}\n" if fit_summary else "",
    )
    with replace_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_twist_card(
    path: Path, settings: TwistSettings, network: TwistRegressor, poses: TrainingPoses, scores: TwistScores
) -> None:
    """Write the card of the twist regressor, replacing the file atomically. Raises WriteError if it cannot be written."""
    rows = format_twist_rows(scores, np.degrees(network.sd_rad[HAS_TWIST]))
    text = TWIST_CARD.format(**build_common_fields(path.stem, settings, poses), rows="\n".join(rows))
    with replace_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def build_common_fields(name: str, settings: PriorSettings | TwistSettings, poses: TrainingPoses) -> dict[str, object]:
    """Return the fields that both cards have: name, training subjects and settings."""
    values = settings.model_dump(exclude={"title", "test_subjects", "held_out_subjects"})
    frame_counts = poses.frame_counts
    if not poses.is_interleaved:
        frame_counts = {subject: count for subject, count in frame_counts.items() if subject not in settings.held_out_subjects}
    return {
        "name": name,
        "title": settings.title,
        "frame_count": sum(frame_counts.values()),
        "subject_count": len(frame_counts),
        "dropped_frames": poses.dropped_frames,
        "trained_on": format_frame_counts(frame_counts),
        "held_out": format_held_out_rows(settings, poses),
        "settings": "\n".join(f"- {key}: {value}" for key, value in values.items()),
        "sources": format_sources(poses.source_frames),
        "acknowledgement": build_acknowledgement(poses.source_frames),
    }


def format_sources(source_frames: Counter[RecordingSource]) -> str:
    """Return the table of the data's known sources, with the frames that were read of each; empty if none is known."""
    sources = sorted(source_frames, key=lambda each: (each.is_retargeted, each.name))
    rows = [f"| {each.name} | {each.licence} | {source_frames[each]:,} |" for each in sources if each.name]
    return "\n".join(["| source | licence | frames |", "|---|---|---|", *rows, "", ""]) if rows else ""


def build_acknowledgement(source_frames: Counter[RecordingSource], *, is_conformed: bool = True) -> str:
    """Return the acknowledgements that the sources ask for.

    is_conformed  whether retargeted motion was brought into CMU's conventions
    """
    is_lab = any(each.name.startswith(MOVEMENT_RESEARCH_LAB) for each in source_frames)
    laboratory = MOVEMENT_RESEARCH_LAB_ACKNOWLEDGEMENT.format(conventions=CONFORMED_POSES if is_conformed else "")
    return ACKNOWLEDGEMENT + (laboratory if is_lab else "")


def format_held_out_rows(settings: PriorSettings | TwistSettings, poses: TrainingPoses) -> str:
    """Return the rows of a card's table of subjects that list the data that was not trained on."""
    if poses.is_interleaved:
        return "| held out, for the scores and the benchmark | two of every five frames, between those trained on |"
    held_out_counts = {subject: count for subject, count in poses.frame_counts.items() if subject in settings.held_out_subjects}
    held_out, test = format_frame_counts(held_out_counts), ", ".join(sorted(settings.test_subjects))
    return f"| held out, for standard deviations and scores | {held_out} |\n| never read, for the benchmarks | {test} |"


def format_frame_counts(frame_counts: dict[str, int]) -> str:
    """Return subjects with their numbers of frames."""
    return ", ".join(f"{subject} ({count:,})" for subject, count in sorted(frame_counts.items()))


def format_twist_rows(scores: TwistScores, sd_deg: Float[np.ndarray, " B"]) -> list[str]:
    """Return the rows of the table of twists: the joints of the left side and the middle, and the mean over all joints."""
    columns = np.stack([*vars(scores).values(), sd_deg], axis=1)
    names = [name for name, has_twist in zip(load_cmu31_skeleton().names, HAS_TWIST, strict=True) if has_twist]
    shown = [i for i, name in enumerate(names) if i <= names.index(mirror_joint_name(name))]
    means = " | ".join(f"{value:.1f}" for value in columns[:, :-1].mean(axis=0))
    rows = [f"| {names[i]} | " + " | ".join(f"{v:.1f}" for v in columns[i]) + " |" for i in shown]
    return [*rows, f"| mean | {means} | |"]
