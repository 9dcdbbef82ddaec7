"""The model card of the motion prior: its data, scores, settings and acknowledgements."""

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.files.output_files import replace_atomically
from mocapfix.train.cards import build_acknowledgement, format_frame_counts, format_sources
from mocapfix.train.motion_windows import MotionStretches
from mocapfix.train.settings import MotionSettings

SCORED_DURATIONS_S = (0.2, 0.4, 0.75, 1.25, 2.1)
"""Limits of the durations that the card distinguishes."""
MOTION_CARD = """\
# {name}

{title}

It is given a second of motion before and after a gap, with what is seen in the gap, and predicts the difference of what is lost
from its interpolation, with standard deviations. Trained by `mocapfix train motion` on {frame_count:,} frames at 30 Hz of
{subject_count} subjects, in windows in which a limb, several limbs or the whole body is lost for 0.2 to 2 s.

| subjects | with their frames |
|---|---|
| trained on | {trained_on} |
| held out, for the scores and the weight of the predictions | {held_out} |
| never read, for the benchmarks | {test} |

## Scores

Mean error of the 31 joints in mm during gaps of held-out people, and the ratio of both.

| lost | seconds | interpolation | prediction | ratio |
|---|---|---|---|---|
{rows}

## Settings

{settings}

## Data

{sources}{acknowledgement}"""


@dataclass(frozen=True)
class GapScores:
    """(N,) gaps of held-out people: whether the whole body is lost, the duration, and the mean joint errors in metres."""

    is_body_gap: Bool[np.ndarray, " N"]
    gap_s: Float[np.ndarray, " N"]
    interpolated_m: Float[np.ndarray, " N"]
    predicted_m: Float[np.ndarray, " N"]


def write_motion_card(
    path: Path, settings: MotionSettings, stretches: MotionStretches, held_out: MotionStretches, scores: GapScores
) -> None:
    """Write the card, replacing the file atomically. Raises WriteError if it cannot be written."""
    frame_counts = stretches.count_frames()
    source_frames = Counter(stretches.count_source_frames() + held_out.count_source_frames())
    values = settings.model_dump(exclude={"title", "test_subjects", "held_out_subjects"})
    text = MOTION_CARD.format(
        name=path.stem,
        title=settings.title,
        frame_count=sum(frame_counts.values()),
        subject_count=len(frame_counts),
        trained_on=format_frame_counts(frame_counts),
        held_out=format_frame_counts(held_out.count_frames()),
        test=", ".join(sorted(settings.test_subjects)),
        rows="\n".join(format_gap_rows(scores)),
        settings="\n".join(f"- {key}: {value}" for key, value in values.items()),
        sources=format_sources(source_frames),
        acknowledgement=build_acknowledgement(source_frames, is_conformed=False),
    )
    with replace_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def format_gap_rows(scores: GapScores) -> list[str]:
    """Return the rows of the table of scores."""
    rows: list[str] = []
    for is_body_gap, lost in ((True, "whole body"), (False, "limbs")):
        for low, high in pairwise(SCORED_DURATIONS_S):
            is_row = (scores.is_body_gap == is_body_gap) & (scores.gap_s >= low) & (scores.gap_s < high)
            if is_row.any():
                before, after = (1e3 * float(each[is_row].mean()) for each in (scores.interpolated_m, scores.predicted_m))
                rows.append(f"| {lost} | {low:g} to {high:g} | {before:.0f} | {after:.0f} | {after / before:.2f} |")
    return rows
