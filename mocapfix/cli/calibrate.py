"""The command `mocapfix calibrate`: bones and marker places of one person, or of all people in takes."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.markup import escape

from mocapfix.cli.arguments import OverwriteOption, TakesArgument, build_options_argument, parse_options
from mocapfix.cli.console import EXIT_DONE, EXIT_FAILED, TakeAttempts, print_line, print_note, print_usage_error, show_progress

SUBJECT_FILE_SUFFIXES = (".yaml", ".yml")

if TYPE_CHECKING:
    CalibrateArguments = object
else:
    CalibrateArguments = build_options_argument(
        ("read", "subject"), without=("subject", "like", "hierarchy"), default_texts={"subject_prefix": "the only subject"}
    )


def run_calibrate(
    takes: TakesArgument,
    output: Annotated[
        Path,
        tyro.conf.arg(aliases=["-o"], metavar="SUBJECT.yaml|DIR", help="subject file, or folder for a file for each person"),
    ],
    options: CalibrateArguments,
    prior: Annotated[str, tyro.conf.arg(metavar="NAME|none", help="prior of the mean pose")] = "mean-pose",
    overwrite: OverwriteOption = False,
) -> int:
    """Calibrate a person's bones and marker positions from takes, for `clean --subject`.

    With a file for output all takes show one person. With a folder, people are recognised by the names in the labels or by the
    folders of the takes, and each gets a file. A take that cannot be used does not stop the others.
    """
    from mocapfix.calibrate.person_files import PersonFiles, locate_person_files, write_person_files
    from mocapfix.files.output_files import check_outputs_absent, make_output_folder
    from mocapfix.jobs.people_calibration import calibrate_one_person, calibrate_people

    if not takes:
        return print_usage_error("calibrate: name at least one take.")
    parsed, is_file = parse_options(options), output.suffix.lower() in SUBJECT_FILE_SUFFIXES
    if is_file:
        check_outputs_absent([output], overwrite)
    attempts = TakeAttempts()
    with show_progress(", ".join(take.name for take in takes), needs_kernels=True) as progress:
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
    for person, of_person in zip(people, files, strict=True):
        subject = person.calibration.subject
        size = f"{len(subject.labels)} markers on {len(subject.skeleton.names)} joints, from {subject.frame_count} frames"
        print_line(f"{escape(str(of_person.main))}: {size}.")
        for note in person.describe():
            print_note(note)
        for take, path in of_person.by_take.items():
            print_line(f"{escape(str(path))}: with the places of the markers in {escape(take)}.")
    return EXIT_FAILED if attempts.failed else EXIT_DONE
