"""The commands that fit what ships in priors/: mocapfix train ..."""

from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape

from mocapfix.console import DONE, Flag, err, out

Config = Annotated[Path, tyro.conf.arg(metavar="NAME.yaml", help="what to train, and how")]
Data = Annotated[Path, tyro.conf.arg(metavar="FOLDER", help="motion: BVH, ASF/AMC, AMASS npz or shards, also in folders within")]
Target = Annotated[
    Path, tyro.conf.arg(name="output", aliases=["-o"], metavar="NAME.safetensors", help="the weights; the card goes beside")
]
Overwrite = Annotated[Flag, tyro.conf.arg(help="replace weights that are there")]


def prior(
    config: Config,
    data: Data,
    target: Target,
    interleaved: Annotated[
        Flag, tyro.conf.arg(help="learn from three frames of every five, of everybody: MNN-IK's split, for `bench prior` only")
    ] = False,
    overwrite: Overwrite = False,
) -> int:
    """Train a pose prior on motion. If it is interrupted, the same command goes on where it was."""
    from mocapfix.files import check_not_there
    from mocapfix.train import prior as training
    from mocapfix.train import settings

    check_not_there([target, target.with_suffix(".md")], overwrite)
    with err.status(escape(target.name)) as status:
        scores = training.train(
            settings.read(config), data, target, lambda what: status.update(f"{escape(target.name)}: {escape(what)}"), interleaved
        )
    out.print(
        f"{escape(str(target))}: gives poses back to {scores.seen:.1f} degrees, and to {scores.unseen:.1f} those "
        f"that were kept from it. {escape(target.with_suffix('.md').name)} says more.",
        soft_wrap=True,
    )
    return DONE


def twist(
    config: Config,
    data: Data,
    target: Target,
    overwrite: Overwrite = False,
) -> int:
    """Train what says from joint positions alone how bones are twisted: a few minutes."""
    from mocapfix.files import check_not_there
    from mocapfix.train import settings
    from mocapfix.train import twist as training

    check_not_there([target, target.with_suffix(".md")], overwrite)
    with err.status(escape(target.name)) as status:
        scores = training.train(
            settings.read_twist(config), data, target, lambda what: status.update(f"{escape(target.name)}: {escape(what)}")
        )
    out.print(
        f"{escape(str(target))}: {scores.regressed.mean():.1f} degrees off the twists of people that were kept from it; "
        f"no twist at all is {scores.zero.mean():.1f} off. {escape(target.with_suffix('.md').name)} says more.",
        soft_wrap=True,
    )
    return DONE


TRAININGS = {"prior": prior, "twist": twist}
