"""Checkpoints of trainings."""

import numpy as np
import pytest
import torch

from mocapfix.errors import ReadError
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.io.yaml_files import read_yaml_model
from mocapfix.lab.settings import MotionSettings, compute_training_fingerprint, resume_training, write_checkpoint

MOTION = np.arange(12.0).reshape(3, 4)


def build_states(width=2):
    return {"network": torch.nn.Linear(width, 2)}


def test_states_are_restored(tmp_path):
    written, read = build_states(), build_states()
    write_checkpoint(tmp_path / "mine", "a", 7, written)
    assert resume_training(tmp_path / "mine", "a", read) == 7
    torch.testing.assert_close(read["network"].weight, written["network"].weight, rtol=0, atol=0)


def test_training_with_other_settings_or_motion_begins_anew(tmp_path):
    settings = read_yaml_model(MotionSettings, find_shipped_folder("priors") / "motion.yaml")
    fingerprint = compute_training_fingerprint(settings, MOTION)
    assert fingerprint == compute_training_fingerprint(settings.model_copy(), MOTION.copy())
    write_checkpoint(tmp_path / "mine", fingerprint, 7, build_states())
    others = (settings.model_copy(update={"learning_rate": 0.1}), MOTION), (settings, MOTION + 1), (settings, MOTION[:, :3])
    for other in others:
        assert resume_training(tmp_path / "mine", compute_training_fingerprint(*other), build_states()) == 0
    assert resume_training(tmp_path / "none", fingerprint, build_states()) == 0


def test_other_files_raise(tmp_path):
    (tmp_path / "text").write_text("weights", encoding="utf-8")
    torch.save({"network": 1}, tmp_path / "no_fingerprint")
    torch.save([1.0], tmp_path / "list")
    write_checkpoint(tmp_path / "wide", "a", 7, build_states(width=5))
    for name in ("text", "no_fingerprint", "list", "wide"):
        with pytest.raises(ReadError, match="is not a training checkpoint"):
            resume_training(tmp_path / name, "a", build_states())
