"""The card of a network of learned inverse kinematics."""

from collections import Counter
from pathlib import Path

from mocapfix.files.output_files import replace_atomically
from mocapfix.train.cards import build_acknowledgement, format_frame_counts, format_sources
from mocapfix.train.frame_pairs import FrameSequences
from mocapfix.train.ik_scores import LOST_SECTION, SCORED_SD_M, IkScores
from mocapfix.train.settings import LearnedIkSettings

IK_CARD = """\
# {name}

{title}

Learnable SMPLify regresses a pose from a start pose and the joint positions of another frame, in one evaluation. Trained by
`mocapfix train ik` on {frame_count:,} frames at about 30 Hz of {subject_count} subjects, half of the batches mirrored.

| subjects | with their frames |
|---|---|
| trained on | {trained_on} |
| held out, for the scores | {held_out} |
| never read, for the benchmarks | {test} |

## Scores

Held-out people, all joints given without noise, one evaluation; means over frames and 31 joints.

| frames at 30 Hz from start to target | {offsets} |
|---|{rule}|
| the start itself, mm | {copied} |
| position, mm | {one_step} |
| world rotation, degrees | {rotation} |
{hard_inputs}
## Settings

{settings}

## Data

{sources}{acknowledgement}"""


def write_ik_card(
    path: Path, settings: LearnedIkSettings, sequences: FrameSequences, held_out: FrameSequences, scores: IkScores
) -> None:
    """Write a card, replacing the file atomically. Raises WriteError if it cannot be written."""
    frame_counts, source_frames = sequences.frame_counts, Counter(sequences.source_frames + held_out.source_frames)
    text = IK_CARD.format(
        sources=format_sources(source_frames),
        name=path.stem,
        title=settings.title,
        frame_count=sum(frame_counts.values()),
        subject_count=len(frame_counts),
        trained_on=format_frame_counts(frame_counts),
        held_out=format_frame_counts(held_out.frame_counts),
        test=", ".join(sorted(settings.test_subjects)),
        offsets=" | ".join(map(str, scores.one_step_mm)),
        rule="|".join("---" for _ in scores.one_step_mm),
        copied=" | ".join(f"{value:.1f}" for value in scores.copied_mm.values()),
        one_step=" | ".join(f"{value:.2f}" for value in scores.one_step_mm.values()),
        rotation=" | ".join(f"{value:.1f}" for value in scores.rotation_deg.values()),
        hard_inputs=format_hard_inputs(scores) if settings.has_corruption else "",
        settings="\n".join(
            f"- {key}: {value}"
            for key, value in settings.model_dump(exclude={"title", "test_subjects", "held_out_subjects"}).items()
        ),
        acknowledgement=build_acknowledgement(source_frames, is_conformed=False),
    )
    with replace_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def format_hard_inputs(scores: IkScores) -> str:
    """Return the sentence on noisy and missing joints."""
    return (
        f"\nWith noise of {1e3 * SCORED_SD_M:.0f} mm per axis and the frame before as the start: {scores.noisy_mm:.1f} mm.\n"
        f"With the joints of the {LOST_SECTION} missing too: {scores.limb_mm:.1f} mm.\n"
    )
