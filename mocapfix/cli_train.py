"""The commands that fit what ships in priors/: mocapfix train ..."""

from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape

from mocapfix.console import DONE, Flag, err, out


def prior(
    config: Annotated[Path, tyro.conf.arg(metavar="NAME.yaml", help="what to train, and how")],
    data: Annotated[
        Path, tyro.conf.arg(metavar="FOLDER", help="motion: BVH, ASF/AMC, AMASS npz or shards, also in folders within")
    ],
    target: Annotated[
        Path, tyro.conf.arg(name="output", aliases=["-o"], metavar="NAME.safetensors", help="the weights; the card goes beside")
    ],
    interleaved: Annotated[
        Flag, tyro.conf.arg(help="learn from three frames of every five, of everybody: MNN-IK's split, for `bench prior` only")
    ] = False,
    overwrite: Annotated[Flag, tyro.conf.arg(help="replace weights that are there")] = False,
) -> int:
    """Train a pose prior on motion. If it is interrupted, the same command goes on where it was."""
    from mocapfix.result import check_not_there
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


TRAININGS = {"prior": prior}
