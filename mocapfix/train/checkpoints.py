"""Checkpoints of trainings, from which an interrupted training continues."""

from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch

from mocapfix.errors import ReadError
from mocapfix.files.output_files import replace_atomically
from mocapfix.train.settings import SubjectSettings


@runtime_checkable
class Stateful(Protocol):
    """A part of the training whose state a checkpoint holds."""

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> object: ...


def compute_training_fingerprint(settings: SubjectSettings, motion: np.ndarray) -> str:
    """Return a string that identifies settings and motion, for the comparison with those of a checkpoint."""
    # The sets of subjects have no defined order; the motion depends on them.
    values = settings.model_dump(exclude={"test_subjects", "held_out_subjects"})
    sums = f"{motion.sum(dtype=float):.9g} {np.abs(motion).sum(dtype=float):.9g}"
    return f"{values} {motion.shape} {sums}"


def write_checkpoint(checkpoint: Path, fingerprint: str, finished: int, states: Mapping[str, Stateful]) -> None:
    """Write a checkpoint, replacing the file atomically.

    finished  number of epochs or steps that are done

    Raises WriteError if it cannot be written.
    """
    state_dicts = {name: each.state_dict() for name, each in states.items()}
    with replace_atomically(checkpoint) as temporary:
        torch.save({"fingerprint": fingerprint, "finished": finished} | state_dicts, temporary)


def resume_training(checkpoint: Path, fingerprint: str, states: Mapping[str, Stateful]) -> int:
    """Return how many epochs or steps are done. If the checkpoint has the same fingerprint, its states are restored; else 0.

    Raises ReadError if a file of this name is not a checkpoint.
    """
    if not checkpoint.is_file():
        return 0
    try:
        content = torch.load(checkpoint, weights_only=True)
        if content["fingerprint"] != fingerprint:
            return 0
        for name, state in states.items():
            state.load_state_dict(content[name])
        return int(content["finished"])
    except (OSError, EOFError, RuntimeError, UnpicklingError, KeyError, TypeError, ValueError) as error:
        raise ReadError(f"{checkpoint}: is not a training checkpoint; move it away.") from error
