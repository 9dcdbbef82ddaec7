"""The commands `mocapfix train ...`: train the models in priors/."""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape

from mocapfix.cli.arguments import FlagOption, OverwriteOption
from mocapfix.cli.console import EXIT_DONE, print_line, stderr_console

ConfigOption = Annotated[Path, tyro.conf.arg(metavar="NAME.yaml", help="training settings")]
MotionFoldersOption = Annotated[
    tuple[Path, ...],
    tyro.conf.arg(metavar="FOLDER [FOLDER ...]", help="motion: BVH, ASF/AMC, AMASS npz or shards, also in subfolders"),
]
WeightsOption = Annotated[
    Path,
    tyro.conf.arg(
        name="output", aliases=["-o"], metavar="NAME.safetensors", help="weights to write; the model card is written beside"
    ),
]


def run_train_prior(
    config: ConfigOption,
    data: MotionFoldersOption,
    target: WeightsOption,
    interleaved: Annotated[
        FlagOption, tyro.conf.arg(help="train on three of every five frames of everybody: MNN-IK's split, for `bench prior` only")
    ] = False,
    overwrite: OverwriteOption = False,
) -> int:
    """Train a pose prior on motion. After an interruption, the same command continues the training."""
    from mocapfix.io.files import check_outputs_absent
    from mocapfix.lab.pose_prior_training import train_pose_prior
    from mocapfix.lab.settings import read_prior_settings

    check_outputs_absent([target, target.with_suffix(".md")], overwrite)
    with _show_training_progress(target) as progress:
        scores = train_pose_prior(read_prior_settings(config), data, target, progress, is_interleaved=interleaved)
    print_line(
        f"{escape(str(target))}: reconstructs training poses to {scores.training_deg:.1f} degrees and held-out poses to "
        f"{scores.held_out_deg:.1f}. Details are in {escape(target.with_suffix('.md').name)}."
    )
    return EXIT_DONE


def run_train_twist(
    config: ConfigOption, data: MotionFoldersOption, target: WeightsOption, overwrite: OverwriteOption = False
) -> int:
    """Train the regressor of bone twists from joint positions; takes a few minutes."""
    from mocapfix.io.files import check_outputs_absent
    from mocapfix.lab.settings import read_twist_settings
    from mocapfix.lab.twist_training import train_twist_regressor

    check_outputs_absent([target, target.with_suffix(".md")], overwrite)
    with _show_training_progress(target) as progress:
        scores = train_twist_regressor(read_twist_settings(config), data, target, progress)
    print_line(
        f"{escape(str(target))}: mean twist error of held-out people {scores.regressed_deg.mean():.1f} degrees; "
        f"{scores.no_twist_deg.mean():.1f} without twist. Details are in {escape(target.with_suffix('.md').name)}."
    )
    return EXIT_DONE


def run_train_ik(
    config: ConfigOption, data: MotionFoldersOption, target: WeightsOption, overwrite: OverwriteOption = False
) -> int:
    """Train learned inverse kinematics (Learnable SMPLify). After an interruption, the same command continues the training."""
    from mocapfix.io.files import check_outputs_absent
    from mocapfix.lab.learned_ik_training import train_learned_ik
    from mocapfix.lab.networks import use_one_torch_thread
    from mocapfix.lab.settings import read_ik_settings

    check_outputs_absent([target, target.with_suffix(".md")], overwrite)
    with _show_training_progress(target) as progress, use_one_torch_thread():
        scores = train_learned_ik(read_ik_settings(config), data, target, progress)
    errors = ", ".join(f"{error_mm:.2f} mm at {offset}" for offset, error_mm in scores.one_step_mm.items())
    print_line(
        f"{escape(str(target))}: joint error of held-out people by frames from the start: {errors}. "
        f"Details are in {escape(target.with_suffix('.md').name)}."
    )
    return EXIT_DONE


def run_train_motion(
    config: ConfigOption, data: MotionFoldersOption, target: WeightsOption, overwrite: OverwriteOption = False
) -> int:
    """Train the motion prior, which predicts lost joints. After an interruption, the same command continues the training."""
    from mocapfix.io.files import check_outputs_absent
    from mocapfix.lab.motion_training import train_motion_prior
    from mocapfix.lab.networks import use_one_torch_thread
    from mocapfix.lab.settings import read_motion_settings

    check_outputs_absent([target, target.with_suffix(".md")], overwrite)
    with _show_training_progress(target) as progress, use_one_torch_thread():
        scores = train_motion_prior(read_motion_settings(config), data, target, progress)
    print_line(
        f"{escape(str(target))}: mean joint error in gaps of held-out people {1e3 * scores.predicted_m.mean():.0f} mm; "
        f"{1e3 * scores.interpolated_m.mean():.0f} mm by interpolation. Details are in "
        f"{escape(target.with_suffix('.md').name)}."
    )
    return EXIT_DONE


@contextmanager
def _show_training_progress(target: Path) -> Generator[Callable[[str], None]]:
    """Yield a function that shows on a terminal what the training is doing."""
    with stderr_console.status(escape(target.name)) as status:
        yield lambda text: status.update(f"{escape(target.name)}: {escape(text)}")


TRAIN_COMMANDS = {"prior": run_train_prior, "twist": run_train_twist, "ik": run_train_ik, "motion": run_train_motion}
