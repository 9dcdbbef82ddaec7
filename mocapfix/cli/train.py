"""The commands that fit what ships in priors/: mocapfix train ..."""

from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape

from mocapfix.cli.arguments import FlagOption
from mocapfix.cli.console import EXIT_DONE, stderr_console, stdout_console

TrainingConfigOption = Annotated[Path, tyro.conf.arg(metavar="NAME.yaml", help="what to train, and how")]
TrainingDataOption = Annotated[
    Path, tyro.conf.arg(metavar="FOLDER", help="motion: BVH, ASF/AMC, AMASS npz or shards, also in folders within")
]
WeightsFileOption = Annotated[
    Path, tyro.conf.arg(name="output", aliases=["-o"], metavar="NAME.safetensors", help="the weights; the card goes beside")
]
OverwriteOption = Annotated[FlagOption, tyro.conf.arg(help="replace weights that are there")]


def run_train_prior(
    config: TrainingConfigOption,
    data: TrainingDataOption,
    target: WeightsFileOption,
    interleaved: Annotated[
        FlagOption,
        tyro.conf.arg(help="learn from three frames of every five, of everybody: MNN-IK's split, for `bench prior` only"),
    ] = False,
    overwrite: OverwriteOption = False,
) -> int:
    """Train a pose prior on motion. If it is interrupted, the same command goes on where it was."""
    from mocapfix.files.output_files import check_outputs_absent
    from mocapfix.train import pose_prior as training
    from mocapfix.train import settings

    check_outputs_absent([target, target.with_suffix(".md")], overwrite)
    with stderr_console.status(escape(target.name)) as status:
        scores = training.train_pose_prior(
            settings.read_prior_settings(config),
            data,
            target,
            lambda what: status.update(f"{escape(target.name)}: {escape(what)}"),
            is_interleaved=interleaved,
        )
    stdout_console.print(
        f"{escape(str(target))}: gives poses back to {scores.training_deg:.1f} degrees, and to {scores.held_out_deg:.1f} those "
        f"that were kept from it. {escape(target.with_suffix('.md').name)} says more.",
        soft_wrap=True,
    )
    return EXIT_DONE


def run_train_twist(
    config: TrainingConfigOption,
    data: TrainingDataOption,
    target: WeightsFileOption,
    overwrite: OverwriteOption = False,
) -> int:
    """Train what says from joint positions alone how bones are twisted: a few minutes."""
    from mocapfix.files.output_files import check_outputs_absent
    from mocapfix.train import settings
    from mocapfix.train import twist as training

    check_outputs_absent([target, target.with_suffix(".md")], overwrite)
    with stderr_console.status(escape(target.name)) as status:
        scores = training.train_twist_regressor(
            settings.read_twist_settings(config),
            data,
            target,
            lambda what: status.update(f"{escape(target.name)}: {escape(what)}"),
        )
    stdout_console.print(
        f"{escape(str(target))}: {scores.regressed_deg.mean():.1f} degrees off the twists of people that were kept from it; "
        f"no twist at all is {scores.no_twist_deg.mean():.1f} off. {escape(target.with_suffix('.md').name)} says more.",
        soft_wrap=True,
    )
    return EXIT_DONE


TRAIN_COMMANDS = {"prior": run_train_prior, "twist": run_train_twist}
