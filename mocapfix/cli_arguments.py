"""Arguments that several commands take."""

from pathlib import Path
from typing import Annotated, Any, Literal

import tyro


def shown(metavar: str, help: str, default: str, **more: Any) -> Any:
    """-> how help shows an argument whose default, None or an empty text, does not say what is then done; `default` does."""
    return tyro.conf.arg(metavar=metavar, help=help, help_behavior_hint=f"(default: {default})", **more)


OneTake = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TAKE", help="a file of captured motion")]
Takes = Annotated[
    tuple[Path, ...],
    tyro.conf.Positional,
    tyro.conf.arg(metavar="TAKE...", help="files of captured motion", help_behavior_hint="(at least one)"),
]
MarkerSetName = Annotated[str | None, shown("NAME|FILE", "which markers", "by the labels")]
SubjectFile = Annotated[Path | None, shown("FILE", "a calibrated subject", "from the take itself")]
PrefixName = Annotated[str | None, shown("NAME", 'the one person of several: "Jim" of Jim:LFHD', "everybody, in turn")]
Up = Annotated[Literal["X", "Y", "Z"] | None, shown("X|Y|Z", "the file's axis to the sky", "as the file tells")]
Hierarchy = Annotated[str | None, shown("STYLE|FILE", "how an animation's joints are called", "as their names tell")]
