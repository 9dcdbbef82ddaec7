"""Files of trained weights, and their cards: training data, scores, settings and acknowledgements."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from safetensors.numpy import save

from mocapfix.io.files import replace_atomically
from mocapfix.lab.recordings import RecordingSource
from mocapfix.lab.settings import SubjectSettings
from mocapfix.model.skeleton import load_cmu31_skeleton
from mocapfix.solve.hybrik import TwistRegressor
from mocapfix.solve.learned_ik import Perceptron
from mocapfix.solve.pose_prior import Header, PoseModel, Tensors

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
CARD = """\
# {name}

{title}

{training} {frame_count:,} frames at about 30 Hz of {subject_count} subjects{use}

| subjects | with their frames |
|---|---|
| trained on | {trained_on} |
| held out, for standard deviations and scores | {held_out} |
| never read, for the benchmarks | {test} |

## Scores

{scores}

## Settings

{settings}

## Data

{sources}{acknowledgement}"""


@dataclass(frozen=True)
class CardData:
    """The motion that weights were trained and scored on."""

    trained_on: Mapping[str, int]  # frames of each subject that was trained on
    held_out: Mapping[str, int]  # the same of the subjects that the scores are measured on
    source_frames: Counter[RecordingSource]  # frames of each source
    is_conformed: bool = False  # whether retargeted motion was brought into CMU's conventions


def write_card(path: Path, settings: SubjectSettings, data: CardData, training: str, use: str, scores: str) -> None:
    """Write a card, replacing the file atomically.

    Args:
        path: Of the card, whose stem is the name of the weights.
        settings: Of the training.
        data: The motion that was used.
        training: What was trained, up to the number of frames.
        use: How the frames were used, after the number of subjects.
        scores: The section of scores.

    Raises:
        WriteError: If it cannot be written.
    """
    values = settings.model_dump(exclude={"title", "test_subjects", "held_out_subjects"})
    text = CARD.format(
        name=path.stem,
        title=settings.title,
        training=training,
        frame_count=sum(data.trained_on.values()),
        subject_count=len(data.trained_on),
        use=use,
        trained_on=format_frame_counts(data.trained_on),
        held_out=format_frame_counts(data.held_out),
        test=", ".join(sorted(settings.test_subjects)),
        scores=scores,
        settings="\n".join(f"- {key}: {value}" for key, value in values.items()),
        sources=format_sources(data.source_frames),
        acknowledgement=build_acknowledgement(data.source_frames, is_conformed=data.is_conformed),
    )
    with replace_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_weights(path: Path, tensors: Tensors, header: Header | None = None) -> None:
    """Write tensors, replacing the file atomically. Raises WriteError if the folder cannot be written."""
    metadata = None if header is None else {"mocapfix": json.dumps(header)}
    with replace_atomically(path) as temporary:
        temporary.write_bytes(save({name: np.ascontiguousarray(values) for name, values in tensors.items()}, metadata))


def write_twist_regressor(path: Path, network: TwistRegressor) -> None:
    """Write a network in half precision (see `write_weights`)."""
    write_weights(path, {"sigma": network.sd_rad.astype(np.float32)} | list_layer_tensors(network.weights, network.biases))


def write_perceptron(path: Path, network: Perceptron, kind: str) -> None:
    """Write a network in half precision (see `write_weights`)."""
    tensors = {"input_mean": network.input_mean.astype(np.float32), "input_scale": network.input_scale.astype(np.float32)}
    header = {"kind": kind, "joints": load_cmu31_skeleton().names}
    write_weights(path, tensors | list_layer_tensors(network.weights, network.biases), header)


def list_layer_tensors(weights: Sequence[np.ndarray], biases: Sequence[np.ndarray]) -> Tensors:
    """Return the tensors of a network's layers in half precision, by their names in a file."""
    kinds = {"weights": weights, "offsets": biases}
    return {f"{kind}.{i}": values.astype(np.float16) for kind, layers in kinds.items() for i, values in enumerate(layers)}


def write_pose_model(path: Path, model: PoseModel) -> None:
    """Write a pose model (see `write_weights`)."""
    header, tensors = model.serialise()
    write_weights(path, tensors, {"kind": model.kind, "joints": model.joint_names, **header})


def format_table(headings: list[str], rows: Mapping[str, list[float]], number_format: str = ".1f") -> str:
    """Return a table of numbers; those that are NaN are empty."""
    lines = [f"| {' | '.join(headings)} |", "|---" * len(headings) + "|"]
    for name, values in rows.items():
        cells = ["" if value != value else format(value, number_format) for value in values]
        lines.append(f"| {' | '.join([name, *cells])} |")
    return "\n".join(lines)


def format_sources(source_frames: Counter[RecordingSource]) -> str:
    """Return the table of the data's known sources, with the frames that were read of each; empty if none is known."""
    sources = sorted(source_frames, key=lambda each: (each.is_retargeted, each.name))
    rows = [f"| {each.name} | {each.licence} | {source_frames[each]:,} |" for each in sources if each.name]
    return "\n".join(["| source | licence | frames |", "|---|---|---|", *rows, "", ""]) if rows else ""


def build_acknowledgement(source_frames: Counter[RecordingSource], *, is_conformed: bool = True) -> str:
    """Return the acknowledgements that the sources ask for.

    Args:
        is_conformed: Whether retargeted motion was brought into CMU's conventions.
    """
    is_lab = any(each.name.startswith(MOVEMENT_RESEARCH_LAB) for each in source_frames)
    laboratory = MOVEMENT_RESEARCH_LAB_ACKNOWLEDGEMENT.format(conventions=CONFORMED_POSES if is_conformed else "")
    return ACKNOWLEDGEMENT + (laboratory if is_lab else "")


def format_frame_counts(frame_counts: Mapping[str, int]) -> str:
    """Return subjects with their numbers of frames."""
    return ", ".join(f"{subject} ({count:,})" for subject, count in sorted(frame_counts.items()))
