"""The commands `mocapfix train ...`: train the models in priors/."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import tyro
from rich.markup import escape

from mocapfix.cli.commands import OverwriteOption
from mocapfix.cli.console import EXIT_DONE, print_line, stderr_console
from mocapfix.errors import ReadError, WriteError
from mocapfix.io.files import check_outputs_absent
from mocapfix.io.yaml_files import read_yaml_model

Settings = TypeVar("Settings")
Scores = TypeVar("Scores")

ConfigOption = Annotated[Path, tyro.conf.arg(metavar="NAME.yaml", help="training settings")]
FolderLists = tyro.conf.UseAppendAction[tuple[tuple[Path, ...], ...]]  # one for each time that the flag is given
MotionFoldersOption = Annotated[
    FolderLists,
    tyro.conf.arg(metavar="FOLDER [FOLDER ...]", help="motion: BVH, ASF/AMC, AMASS npz or shards, also in subfolders"),
]
WeightsOption = Annotated[
    Path,
    tyro.conf.arg(
        name="output", aliases=["-o"], metavar="NAME.safetensors", help="weights to write; the model card is written beside"
    ),
]


def run_train_prior(
    config: ConfigOption, data: MotionFoldersOption, target: WeightsOption, overwrite: OverwriteOption = False
) -> int:
    """Train a pose prior on motion. After an interruption, the same command continues the training."""
    from mocapfix.lab.pose_prior_training import train_pose_prior
    from mocapfix.lab.settings import read_prior_settings

    scores = _train(train_pose_prior, read_prior_settings(config), data, target, overwrite)
    errors = f"{scores.training_deg:.1f} degrees and held-out poses to {scores.held_out_deg:.1f}"
    return _print_scores(target, f"reconstructs training poses to {errors}")


def run_train_twist(
    config: ConfigOption, data: MotionFoldersOption, target: WeightsOption, overwrite: OverwriteOption = False
) -> int:
    """Train the regressor of bone twists from joint positions; takes a few minutes."""
    from mocapfix.lab.settings import TwistSettings
    from mocapfix.lab.twist_training import train_twist_regressor

    scores = _train(train_twist_regressor, read_yaml_model(TwistSettings, config), data, target, overwrite)
    errors = f"{scores.regressed_deg.mean():.1f} degrees; {scores.no_twist_deg.mean():.1f} without twist"
    return _print_scores(target, f"mean twist error of held-out people {errors}")


def run_train_ik(
    config: ConfigOption, data: MotionFoldersOption, target: WeightsOption, overwrite: OverwriteOption = False
) -> int:
    """Train learned inverse kinematics (Learnable SMPLify). After an interruption, the same command continues the training."""
    from mocapfix.lab.learned_ik_training import train_learned_ik
    from mocapfix.lab.settings import LearnedIkSettings

    scores = _train(train_learned_ik, read_yaml_model(LearnedIkSettings, config), data, target, overwrite)
    errors = ", ".join(f"{error_mm:.2f} mm at {offset}" for offset, error_mm in scores.one_step_mm.items())
    return _print_scores(target, f"joint error of held-out people by frames from the start: {errors}")


def run_train_motion(
    config: ConfigOption, data: MotionFoldersOption, target: WeightsOption, overwrite: OverwriteOption = False
) -> int:
    """Train the motion prior, which predicts lost joints. After an interruption, the same command continues the training."""
    from mocapfix.lab.motion_training import train_motion_prior
    from mocapfix.lab.settings import MotionSettings

    scores = _train(train_motion_prior, read_yaml_model(MotionSettings, config), data, target, overwrite)
    errors = f"{1e3 * scores.predicted_m.mean():.0f} mm; {1e3 * scores.interpolated_m.mean():.0f} mm by interpolation"
    return _print_scores(target, f"mean joint error in gaps of held-out people {errors}")


def run_train_contacts(
    config: ConfigOption, data: MotionFoldersOption, target: WeightsOption, overwrite: OverwriteOption = False
) -> int:
    """Train the network that tells the contacts of feet that no marker shows; takes some minutes, most of them to clean takes."""
    from mocapfix.contacts.find_contacts import MIN_CONTACT_PROBABILITY
    from mocapfix.lab.contact_training import train_contact_network
    from mocapfix.lab.settings import ContactSettings

    scores = _train(train_contact_network, read_yaml_model(ContactSettings, config), data, target, overwrite)
    precision, recall, f1, *_ = scores[round(10 * MIN_CONTACT_PROBABILITY)]
    return _print_scores(target, f"contacts of held-out people: precision {precision:.3f}, recall {recall:.3f}, F1 {f1:.3f}")


def _train(
    train: Callable[[Settings, tuple[Path, ...], Path, Callable[[str], None]], Scores],
    settings: Settings,
    data: tuple[tuple[Path, ...], ...],
    target: Path,
    overwrite: bool,
) -> Scores:
    """Train with torch on one thread, and show on a terminal what the training is doing."""
    from mocapfix.lab.networks import use_one_torch_thread

    if target.suffix != ".safetensors":
        raise WriteError(f"{target}: weights are written as safetensors; give a name that ends in .safetensors.")
    if not (folders := sum(data, ())):
        raise ReadError("No motion to train on; give its folders with --data.")
    check_outputs_absent([target, target.with_suffix(".md")], overwrite)
    with stderr_console.status(escape(target.name)) as status, use_one_torch_thread():
        return train(settings, folders, target, lambda text: status.update(f"{escape(target.name)}: {escape(text)}"))


def _print_scores(target: Path, scores: str) -> int:
    print_line(f"{escape(str(target))}: {scores}. Details are in {escape(target.with_suffix('.md').name)}.")
    return EXIT_DONE


TRAIN_COMMANDS = {"prior": run_train_prior, "twist": run_train_twist, "ik": run_train_ik, "motion": run_train_motion} | {
    "contacts": run_train_contacts
}
