"""The commands about marker sets: `mocapfix marker-set list`, `show` and `learn`.

The command `mocapfix calibrate`: bones and marker places of one person, or of all people in takes.

The command `mocapfix label`: give the trajectories of a take the labels of a marker set.
"""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from mocapfix.cli import commands, console
from mocapfix.errors import WriteError

if TYPE_CHECKING:
    from mocapfix.model.marker_set import MarkerSet
    from mocapfix.solve.person_memory import PersonMemory


def run_marker_set_list() -> int:
    """List the shipped marker sets."""
    from mocapfix.subject.library import load_shipped_marker_sets

    table = Table("name", "title", "markers", "of them optional")
    for each in load_shipped_marker_sets():
        table.add_row(each.name, each.title, str(len(each.labels)), str(len(each.optional_labels)))
    console.stdout_console.print(table)
    return console.EXIT_DONE


def run_marker_set_show(
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME|FILE", help="a shipped set, or a YAML file")],
) -> int:
    """Show the markers of a set by segment, and their other names."""
    from mocapfix.subject.library import load_marker_set

    marker_set = load_marker_set(name)
    size = f"{len(marker_set.labels)} markers"
    console.stdout_console.print(f"[bold]{escape(marker_set.name)}[/]: {escape(marker_set.title)}, {size}.")
    _print_segments(marker_set)
    named = zip(marker_set.labels, marker_set.aliases, strict=True)
    if aliases := [f"{label} ({', '.join(names)})" for label, names in named if names]:
        console.print_line(f"Other names: {escape(', '.join(aliases))}.")
    if optional := [label for label in marker_set.labels if label in marker_set.optional_labels]:
        console.print_line(f"Optional: {escape(', '.join(optional))}.")
    return console.EXIT_DONE


def run_marker_set_learn(
    take: commands.TakeArgument,
    options: Annotated[object, commands.build_options_argument(("read",))],
    output_path: Annotated[
        Path, tyro.conf.arg(name="output", aliases=["-o"], metavar="NAME.yaml", help="the marker set to write")
    ],
    like: Annotated[
        str | None, commands.describe_option("NAME|FILE", "a marker set to which some of the labels belong", "by the labels")
    ] = None,
    subject_prefix: Annotated[
        str | None, commands.describe_option("NAME", 'the subject: "Jim" of Jim:LFHD', "the one with the most markers")
    ] = None,
    overwrite: commands.OverwriteOption = False,
) -> int:
    """Learn a marker set from a take, for `clean --marker-set`: the segment and the offset of each marker.

    The person in the take should move all joints. Markers that move with no segment, such as those of a prop, are left out and
    listed. If the labels contain no known words, the body is located by the positions and the motion of the markers; then at
    least one frame must show the person standing.
    """
    from mocapfix.io.files import check_outputs_absent
    from mocapfix.subject.learning import learn_marker_set
    from mocapfix.subject.library import write_marker_set

    check_outputs_absent([output_path], overwrite)
    with console.show_progress(take.name) as progress:
        read = commands.parse_options(options).read
        learned = learn_marker_set(
            take, output_path.stem, like=like, subject_prefix=subject_prefix, options=read, progress=progress
        )
        write_marker_set(output_path, learned.marker_set, learned.file_comment)
    marker_count, residual_mm = len(learned.marker_set.labels), learned.mean_residual_m * 1e3
    console.print_line(f"[bold]{escape(str(output_path))}[/]: {marker_count} markers, mean residual {residual_mm:.1f} mm.")
    console.print_line(f"  {escape(learned.guess_description)}")
    _print_segments(learned.marker_set)
    for name, labels in learned.marker_set.props.items():
        console.print_line(f"  prop: {escape(name)}, {escape(', '.join(labels))}.")
    for label, joint_name in learned.ambiguous_markers.items():
        console.print_line(f"  ambiguous: {escape(label)} may be attached to {joint_name} instead.")
    for label, reason in learned.excluded_markers.items():
        console.print_line(f"  not included: {escape(label)} {escape(reason)}.")
    command = escape(shlex.join(["mocapfix", "clean", str(take), "--marker-set", str(output_path)]))
    console.print_line(f"  To clean with it: {command}")
    return console.EXIT_DONE


def _print_segments(marker_set: "MarkerSet") -> None:
    from mocapfix.model.skeleton import load_cmu31_body

    table = Table("segment", "markers")
    for joint in sorted(set(marker_set.joints.tolist())):
        labels = [label for label, j in zip(marker_set.labels, marker_set.joints, strict=True) if j == joint]
        table.add_row(load_cmu31_body().skeleton.names[joint], escape(", ".join(labels)))
    console.stdout_console.print(table)


MARKER_SET_COMMANDS = {"list": run_marker_set_list, "show": run_marker_set_show, "learn": run_marker_set_learn}


SUBJECT_FILE_SUFFIXES = (".yaml", ".yml")

CALIBRATE_ARGUMENTS = commands.build_options_argument(
    ("read", "subject"), without=("subject", "like", "hierarchy"), default_texts={"subject_prefix": "the only subject"}
)


def run_calibrate(
    takes: commands.TakesArgument,
    output: Annotated[
        Path, tyro.conf.arg(aliases=["-o"], metavar="SUBJECT.yaml|DIR", help="subject file, or folder for a file for each person")
    ],
    options: Annotated[object, CALIBRATE_ARGUMENTS],
    prior: Annotated[str, tyro.conf.arg(metavar="NAME|none", help="prior of the mean pose")] = "mean-pose",
    person_memory: Annotated[
        Path | None,
        commands.describe_option("FILE", "also write how the person moves in these takes, for `clean --person-memory`", "none"),
    ] = None,
    overwrite: commands.OverwriteOption = False,
) -> int:
    """Calibrate a person's bones and marker positions from takes, for `clean --subject`.

    With a file for output all takes show one person. With a folder, people are recognised by the names in the labels or by the
    folders of the takes, and each gets a file. A take that cannot be used does not stop the others.
    """
    from mocapfix import pipeline
    from mocapfix.io.files import check_outputs_absent, make_output_folder
    from mocapfix.solve.person_memory import join_memories, write_memory
    from mocapfix.subject.people import (
        PersonFiles,
        calibrate_one_person,
        calibrate_people,
        locate_person_files,
        name_takes,
        write_person_files,
    )

    if not takes:
        return console.print_usage_error("calibrate: name at least one take.")
    parsed, is_file = commands.parse_options(options), output.suffix.lower() in SUBJECT_FILE_SUFFIXES
    if person_memory and (not is_file or person_memory.resolve() == output.resolve()):
        return console.print_usage_error("calibrate: --person-memory is of one person; give --output another file, NAME.yaml.")
    if is_file:
        check_outputs_absent([output, *([person_memory] if person_memory else [])], overwrite)
    attempts = console.TakeAttempts()
    with console.show_progress(", ".join(take.name for take in takes), needs_kernels=True) as progress:
        progress("calibrate")
        if is_file:
            people = calibrate_one_person(takes, parsed, prior, attempts.attempt)
            files = [PersonFiles(output, {}) for _ in people]
        else:
            people = calibrate_people(takes, parsed, prior, attempts.attempt)
            files = [locate_person_files(output, person.name, person.calibration) for person in people]
            check_outputs_absent([path for each in files for path in (each.main, *each.by_take.values())], overwrite)
            if people:
                make_output_folder(output)
        for person, of_person in zip(people, files, strict=True):
            write_person_files(of_person, person.calibration)
        memories: list[PersonMemory] = []
        for take, take_id in zip(takes, name_takes(takes), strict=True):
            if person_memory and take not in attempts.failed and take_id not in people[0].calibration.rejected:
                progress(f"remember {take.name}")
                with attempts.attempt(take):
                    known = parsed.change(subject=people[0].calibration.subject)
                    memories += pipeline.remember_take(take, take.stem, known).values()
        if person_memory and memories:
            write_memory(person_memory, join_memories(memories))
    for person, of_person in zip(people, files, strict=True):
        subject = person.calibration.subject
        size = f"{len(subject.labels)} markers on {len(subject.skeleton.names)} joints, from {subject.frame_count} frames"
        console.print_line(f"{escape(str(of_person.main))}: {size}.")
        for note in person.describe():
            console.print_note(note)
        for take, path in of_person.by_take.items():
            console.print_line(f"{escape(str(path))}: with the places of the markers in {escape(take)}.")
    if person_memory and memories:
        noun = "take" if len(memories) == 1 else "takes"
        console.print_line(f"{escape(str(person_memory))}: how the person moves in {len(memories)} {noun}.")
    return console.EXIT_FAILED if attempts.failed else console.EXIT_DONE


def run_label(
    take: commands.TakeArgument,
    options: Annotated[object, commands.build_options_argument(("read", "subject"), without=("hierarchy", "subject_prefix"))],
    output_path: Annotated[
        Path | None,
        commands.describe_option(
            "FILE", "the labelled file", "TAKE.labelled with the suffix of the take", name="output", aliases=["-o"]
        ),
    ] = None,
    overwrite: commands.OverwriteOption = False,
) -> int:
    """Label a take whose trajectories have no labels, or whose points are not yet trajectories.

    Name the markers with --marker-set, the person with --subject, or a labelled take of the same person with --like; otherwise
    the shipped marker set that fits the points clearly is assumed, and if none does, the markers are numbered. The output is the
    input with the names of the markers; trajectories of the same marker are joined in one column. Nothing else is changed.
    """
    from mocapfix import pipeline
    from mocapfix.io.files import check_outputs_absent, replace_atomically

    target = output_path or take.with_name(f"{take.stem}.labelled{take.suffix}")
    if target.exists() and take.exists() and target.samefile(take):
        raise WriteError(f"{take}: would be replaced by its labelled copy; name another file with --output.")
    check_outputs_absent([target], overwrite)
    with console.show_progress(take.name, needs_kernels=True) as progress:
        labelled = pipeline.label(take, commands.parse_options(options), progress=progress)
    assert labelled.labelled_file is not None
    with replace_atomically(target) as part:
        part.write_bytes(labelled.labelled_file)
    console.print_line(f"[bold]{escape(str(target))}[/]")
    for note in labelled.notes:
        console.print_note(note)
    return console.EXIT_DONE
