from functools import partial

import pytest

from mocapfix.errors import SceneError
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.io.yaml_files import read_yaml_model
from mocapfix.lab import settings
from mocapfix.lab.sound_takes import UNSEEN_SUBJECTS

PCA = """\
model: linear
title: mine
test_subjects: ["02"]
held_out_subjects: ["03"]
subject_balance: 0.5
retargeted_weight: 1
components: 3
"""


def test_no_training_reads_the_subjects_of_the_benchmarks():
    folder = find_shipped_folder("priors")
    held_out = settings.read_prior_settings(folder / "autoencoder.yaml").held_out_subjects
    assert not held_out & UNSEEN_SUBJECTS
    for read, names in (
        (settings.read_prior_settings, ("autoencoder", "gaussian", "mixture", "mnn-ik", "pca")),
        (partial(read_yaml_model, settings.TwistSettings), ("twist",)),
        (partial(read_yaml_model, settings.LearnedIkSettings), ("ik",)),
        (partial(read_yaml_model, settings.MotionSettings), ("motion",)),
        (partial(read_yaml_model, settings.ContactSettings), ("contacts",)),
    ):
        for name in names:
            shipped = read(folder / f"{name}.yaml")
            assert (shipped.test_subjects, shipped.held_out_subjects) == (UNSEEN_SUBJECTS, held_out), name


def test_invalid_settings_of_learned_ik_raise(tmp_path):
    text = (find_shipped_folder("priors") / "ik.yaml").read_text(encoding="utf-8")
    (tmp_path / "mine.yaml").write_text(text.replace("frame_offsets: [1, 3, 5, 7, 9]", "frame_offsets: []"), encoding="utf-8")
    with pytest.raises(SceneError, match=r"mine\.yaml: .*frame_offsets"):
        read_yaml_model(settings.LearnedIkSettings, tmp_path / "mine.yaml")


def test_settings_of_the_wrong_model_raise():
    with pytest.raises(SceneError, match=r"twist\.yaml: model: .*'twist'"):
        settings.read_prior_settings(find_shipped_folder("priors") / "twist.yaml")
    with pytest.raises(SceneError, match=r"pca\.yaml: model: .*'twist'"):
        read_yaml_model(settings.TwistSettings, find_shipped_folder("priors") / "pca.yaml")


def test_mnn_ik_settings_are_those_of_the_paper():
    shipped = settings.read_prior_settings(find_shipped_folder("priors") / "mnn-ik.yaml")
    assert isinstance(shipped, settings.AutoencoderSettings)
    assert (shipped.input_features, shipped.hidden_widths, shipped.code_size, shipped.activation) == (
        "euler",
        (1024, 1024, 1024),
        35,
        "relu",
    )
    assert (shipped.learning_rate, shipped.rate_schedule, shipped.corrupted_share) == (1e-4, 0.98, False)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("components: 3", "components: 0", "components"),
        ("components: 3", "components: 3\nlayers: 4", "layers"),
        ('test_subjects: ["02"]', "tests: []", "test_subjects"),
        ("retargeted_weight: 1", "retargeted_weight: 0", "retargeted_weight"),
        ("model: linear", "model: forest", "model"),
        ("model: linear", "", "model"),
    ],
)
def test_invalid_settings_raise_with_file_and_key(tmp_path, old, new, message):
    (tmp_path / "mine.yaml").write_text(PCA.replace(old, new), encoding="utf-8")
    with pytest.raises(SceneError, match=rf"mine\.yaml: .*{message}"):
        settings.read_prior_settings(tmp_path / "mine.yaml")
