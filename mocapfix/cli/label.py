"""The command `mocapfix label`: give the trajectories of a take the labels of a marker set."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.markup import escape

from mocapfix.cli.arguments import OverwriteOption, TakeArgument, build_options_argument, describe_option, parse_options
from mocapfix.cli.console import EXIT_DONE, print_line, print_note, show_progress
from mocapfix.errors import WriteError

if TYPE_CHECKING:
    LabelArguments = object
else:
    LabelArguments = build_options_argument(("read", "subject"), without=("hierarchy", "subject_prefix"))


def run_label(
    take: TakeArgument,
    options: LabelArguments,
    output_path: Annotated[
        Path | None,
        describe_option("FILE", "the labelled file", "TAKE.labelled with the suffix of the take", name="output", aliases=["-o"]),
    ] = None,
    overwrite: OverwriteOption = False,
) -> int:
    """Label a take whose trajectories have no labels, or whose points are not yet trajectories.

    Name the markers with --marker-set, the person with --subject, or a labelled take of the same person with --like; otherwise
    the shipped marker set that fits the points clearly is assumed, and if none does, the markers are numbered. The output is the
    input with the names of the markers; trajectories of the same marker are joined in one column. Nothing else is changed.
    """
    from mocapfix import pipeline
    from mocapfix.files.output_files import check_outputs_absent, replace_atomically

    target = output_path or take.with_name(f"{take.stem}.labelled{take.suffix}")
    if target.exists() and take.exists() and target.samefile(take):
        raise WriteError(f"{take}: would be replaced by its labelled copy; name another file with --output.")
    check_outputs_absent([target], overwrite)
    parsed = parse_options(options)
    with show_progress(take.name, needs_kernels=True) as progress:
        labelled = pipeline.label(take, parsed, progress=progress)
    assert labelled.labelled_file is not None
    with replace_atomically(target) as part:
        part.write_bytes(labelled.labelled_file)
    print_line(f"[bold]{escape(str(target))}[/]")
    for note in labelled.notes:
        print_note(note)
    return EXIT_DONE
