"""Arguments that several commands take."""

from pathlib import Path
from typing import Annotated, Any, Literal

import tyro


def describe_option(metavar: str, help: str, default: str, **more: Any) -> Any:
    """-> how help shows an argument whose default, None or an empty text, does not say what is then done; `default` does."""
    return tyro.conf.arg(metavar=metavar, help=help, help_behavior_hint=f"(default: {default})", **more)


TakeArgument = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TAKE", help="a file of captured motion")]
TakesArgument = Annotated[
    tuple[Path, ...],
    tyro.conf.Positional,
    tyro.conf.arg(metavar="TAKE...", help="files of captured motion", help_behavior_hint="(at least one)"),
]
MarkerSetOption = Annotated[str | None, describe_option("NAME|FILE", "which markers", "by the labels")]
SubjectOption = Annotated[Path | None, describe_option("FILE", "a calibrated subject", "from the take itself")]
SubjectPrefixOption = Annotated[
    str | None, describe_option("NAME", 'the one person of several: "Jim" of Jim:LFHD', "everybody, in turn")
]
UpAxisOption = Annotated[
    Literal["X", "Y", "Z"] | None, describe_option("X|Y|Z", "the file's axis to the sky", "as the file tells")
]
HierarchyOption = Annotated[
    str | None, describe_option("STYLE|FILE", "how an animation's joints are called", "as their names tell")
]
