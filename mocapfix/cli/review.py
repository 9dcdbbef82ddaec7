"""The commands `mocapfix review` and `mocapfix status`: review cleaned takes in the browser, and list how far that is."""

import importlib.util
import webbrowser
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from mocapfix.cli.arguments import JsonOption, describe_option
from mocapfix.cli.console import EXIT_DONE, EXIT_FAILED, print_error, print_json, print_line, stdout_console
from mocapfix.errors import ReadError, format_name_list

REVIEW_PACKAGES = ("nicegui", "starlette", "uvicorn")

FolderArgument = Annotated[
    Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR", help="output folder of `mocapfix clean` or `mocapfix batch`")
]


def run_review(
    folder: FolderArgument,
    *,
    take: Annotated[str | None, describe_option("NAME", "open this take first", "the first that is not approved")] = None,
    port: Annotated[int, tyro.conf.arg(metavar="N", help="port on this computer; 0 for any free one")] = 0,
    browser: Annotated[bool, tyro.conf.arg(help="open the page in the browser")] = True,
) -> int:
    """Review the changes to cleaned takes in the browser: see each where it happened, and accept or reject it with a key.

    The page is served to this computer only. Every decision is saved at once in the changes file of the take.
    """
    if missing := [name for name in REVIEW_PACKAGES if importlib.util.find_spec(name) is None]:
        raise ReadError(f"The review needs {' and '.join(missing)}; install it with: pip install 'mocapfix[review]'.")
    from mocapfix.batch.records import BATCH_LOCK_NAME
    from mocapfix.io.files import hold_process_lock
    from mocapfix.review.review_session import ReviewSession, describe_other_review
    from mocapfix.review.server import ReviewServer, find_three_module

    find_three_module()  # raises ReadError if it is not installed
    session = ReviewSession(folder)
    start = ""
    if take is not None:
        matching = [each for each in session.ids if take in (each, Path(each).name)]
        if not matching:
            raise ReadError(f"{folder}: has no take {take!r}; its takes are {format_name_list(session.ids)}.")
        start = f"#{matching[0]}"

    with ExitStack() as locks:
        if (folder / BATCH_LOCK_NAME).exists():
            locks.enter_context(hold_process_lock(folder / BATCH_LOCK_NAME, partial(describe_other_review, folder)))
        if len(session.ids) == 1:
            session.open_take(session.ids[0])  # refuses at once what another process reviews
        server = ReviewServer(session, port)
        print_line(f"Review of {escape(str(folder))}: {escape(server.address + start)}")
        print_line("End it with Ctrl-C, or by closing the page.")
        stdout_console.file.flush()
        if browser:
            webbrowser.open(server.address + start)
        try:
            server.serve()
        except KeyboardInterrupt:
            print_line("The review has ended; every decision is saved.")
    return EXIT_DONE


def run_status(folder: FolderArgument, as_json: JsonOption = False) -> int:
    """List the cleaned takes in a folder, and how far the review of each is."""
    from mocapfix.review.review_session import describe_take
    from mocapfix.review.take_files import find_cleaned_takes

    takes = [describe_take(take) for take in find_cleaned_takes(folder)]
    if as_json:
        print_json(takes)
        return EXIT_DONE
    table = Table("Take", "State", "Changes", "Reviewed", "Worst, mm", "Approved")
    for each in takes:
        worst = "" if each["worst_mm"] is None else f"{each['worst_mm']:.1f}"
        approved = f"{each['approved_by']}, {each['approved_at'][:16].replace('T', ' ')}" if each["approved_by"] else ""
        counts = (str(each["change_count"]), str(each["reviewed_count"]))
        table.add_row(escape(each["id"]), "unreadable" if each["error"] else each["state"], *counts, worst, escape(approved))
    stdout_console.print(table)
    for each in takes:
        if each["error"]:
            print_error(each["error"])
    return EXIT_FAILED if any(each["error"] for each in takes) else EXIT_DONE
