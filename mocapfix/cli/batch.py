"""The command `mocapfix batch`: clean all takes of a session on the cores of this machine or on a cluster."""

import os
import shlex
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.markup import escape

from mocapfix.cli.arguments import FlagOption, build_options_argument, describe_option, parse_options, split_names
from mocapfix.cli.clean import STAGES, describe_laboratory
from mocapfix.cli.console import EXIT_DONE, EXIT_FAILED, compile_kernels_first, print_error, print_line, print_usage_error
from mocapfix.errors import MocapfixError

SESSION_SUFFIXES = (".yaml", ".yml")
DEFAULT_TIMEOUT_S = 3600.0
DEFAULT_MEMORY_MB = 4000.0
DEFAULT_RETRIES = 1
if TYPE_CHECKING:
    BatchArguments = object
else:
    BatchArguments = build_options_argument(STAGES, without=("review_files",))


def run_batch(
    takes: Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="FOLDER|PATTERN|SESSION.yaml", help="the takes", help_behavior_hint="(at least one)"),
    ],
    output_folder: Annotated[
        Path, tyro.conf.arg(name="out", aliases=["-o"], metavar="DIR", help="folder for outputs and records")
    ],
    options: BatchArguments,
    *,
    workers: Annotated[int | None, describe_option("N", "worker processes, or Slurm jobs", "one a core")] = None,
    scheduler: Annotated[str | None, describe_option("ADDRESS", "use the Dask scheduler that runs there", "none")] = None,
    slurm: Annotated[
        FlagOption, tyro.conf.arg(help="start the workers as Slurm jobs (jobqueue.slurm of Dask's configuration)")
    ] = False,
    ssh: Annotated[str, tyro.conf.arg(metavar="HOST,...", help="start the workers on these computers over SSH")] = "",
    timeout: Annotated[float, tyro.conf.arg(metavar="SECONDS", help="end a take after this time")] = DEFAULT_TIMEOUT_S,
    memory: Annotated[float, tyro.conf.arg(metavar="MB", help="end a take that needs more memory")] = DEFAULT_MEMORY_MB,
    retries: Annotated[int, tyro.conf.arg(metavar="N", help="repeat a take whose process crashed, this often")] = DEFAULT_RETRIES,
    repeat_failed: Annotated[FlagOption, tyro.conf.arg(help="clean takes that failed again, although nothing changed")] = False,
    people: Annotated[
        Literal["session", "each-take"], tyro.conf.arg(help="calibrate each person from all takes, or in each take alone")
    ] = "session",
    resume: Annotated[bool, tyro.conf.arg(help="skip takes that are done and unchanged")] = True,
) -> int:
    """Clean all takes of a session, on all cores or on a cluster, and write a page on them.

    Every take is cleaned in a process of its own, with limits. Takes that fail do not stop the others. An interrupted batch
    goes on where it was.
    """
    from mocapfix.write.output_formats import list_output_formats

    if not hasattr(os, "fork"):
        return print_usage_error("batch: needs Linux or macOS; on Windows run it in WSL, or use `mocapfix clean`.")
    if not takes:
        return print_usage_error("batch: name a folder, a pattern or a session file.")
    if sum((scheduler is not None, slurm, bool(ssh))) > 1:
        return print_usage_error("Give one of --scheduler, --slurm and --ssh.")
    limits_problem = find_limits_problem(workers, timeout, memory, retries)
    if limits_problem:
        return print_usage_error(limits_problem)
    parsed = parse_options(options)
    try:
        list_output_formats(parsed.output)
    except MocapfixError as error:
        return print_usage_error(str(error))

    from mocapfix.batch.child_process import JobLimits
    from mocapfix.batch.cluster import ClusterOptions, check_dask_installed
    from mocapfix.batch.run_session import BatchSettings, run_session
    from mocapfix.batch.session_page import PAGE_NAME, write_session_page
    from mocapfix.batch.take_list import find_takes
    from mocapfix.cli.batch_progress import show_batch_progress
    from mocapfix.marker_sets.library import load_requested_subject

    cluster = ClusterOptions(workers, scheduler, slurm, split_names([ssh]))
    check_dask_installed(cluster)
    if len(takes) == 1 and Path(takes[0]).suffix.lower() in SESSION_SUFFIXES:
        from mocapfix.batch.session_file import read_session_file
        from mocapfix.options import CleanOptions

        if parsed != CleanOptions():
            return print_usage_error("With a session file the options of cleaning are in that file.")
        session = read_session_file(Path(takes[0]))
        title, found, parsed, named_people = session.title, session.takes, session.options, session.people
    else:
        listed = find_takes(takes, output_folder)
        title, found, named_people = "", listed.takes, {}
        for path in listed.unreadable:
            print_error(f"{path}: cannot be read, so its takes are not cleaned; check its permissions.")
        for path in listed.skipped:
            print_line(f"{escape(str(path))}: not cleaned, since a file beside it with another suffix is the take.")
    load_requested_subject(parsed.subject)  # a name that is wrong is so for all takes
    settings = BatchSettings(
        output_folder,
        parsed,
        JobLimits(timeout, memory, retries),
        cluster,
        resume,
        repeat_failed,
        each_take_alone=people == "each-take",
        people=named_people,
    )
    if scheduler is None and not slurm and not ssh:
        compile_kernels_first(lambda text: None)
    with show_batch_progress() as progress:
        records = run_session(found, settings, progress, partial(write_session_page, title=title))
    failed_count = sum(record.status == "failed" for record in records)
    for record in records:
        if record.status == "failed" and record.take not in progress.shown_failures:
            print_error(f"{record.take} failed in an earlier batch (--repeat-failed cleans it again): {record.error}")
    print_line(
        f"{len(records) - failed_count:,} of {len(records):,} takes are done, {failed_count:,} failed. "
        f"Page: {escape(str(output_folder / PAGE_NAME))}"
    )
    laboratory = {record.take: next((each.laboratory for each in record.subjects if each.laboratory), "") for record in records}
    if note := describe_laboratory(laboratory, parsed):
        print_line(escape(note))
    if failed_count < len(records):
        print_line(f"To look at the changes in the browser: mocapfix review {escape(shlex.quote(str(output_folder)))}")
    return EXIT_FAILED if failed_count else EXIT_DONE


def find_limits_problem(workers: int | None, timeout_s: float, memory_mb: float, retries: int) -> str:
    """Return what is wrong with the numbers of the command; "" if they are allowed."""
    if workers is not None and workers < 1:
        return f"--workers must be at least 1, not {workers}."
    if not timeout_s > 0:
        return f"--timeout must be greater than 0 s, not {timeout_s:g}."
    if not memory_mb > 0:
        return f"--memory must be greater than 0 MB, not {memory_mb:g}."
    return f"--retries must be at least 0, not {retries}." if retries < 0 else ""
