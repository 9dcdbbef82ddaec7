"""The commands with their arguments, for the parser: tyro. Each imports what it runs.

Every stage of `CleanOptions` becomes a group of arguments, every option of it a flag.
"""

import getpass
import importlib.util
import json
import subprocess
import sys
import webbrowser
from collections.abc import Iterable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import field, fields, make_dataclass
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, cast, get_args

import tyro
from rich.markup import escape
from rich.table import Table

from mocapfix.cli import console
from mocapfix.errors import ReadError, SceneError, format_name_list
from mocapfix.io.files import JSON_REPORT_SUFFIX
from mocapfix.option import Option
from mocapfix.options import OPTIONS, PURPOSE_OPTIONS, CleanOptions, build_clean_options

FlagOption = tyro.conf.FlagCreatePairsOff[bool]
JsonOption = Annotated[FlagOption, tyro.conf.arg(name="json", help="print JSON instead of a table")]
OverwriteOption = Annotated[FlagOption, tyro.conf.arg(help="replace existing files")]
TakeArgument = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TAKE", help="motion capture file")]
TakesArgument = Annotated[
    tuple[Path, ...],
    tyro.conf.Positional,
    tyro.conf.arg(metavar="TAKE...", help="motion capture files", help_behavior_hint="(at least one)"),
]


def describe_option(metavar: str, help: str, default: str, **details: Any) -> Any:
    """Return how help shows an argument whose default value does not explain itself; `default` is the text that does."""
    return tyro.conf.arg(metavar=metavar, help=help, help_behavior_hint=f"(default: {default})", **details)


def build_options_argument(
    stages: tuple[str, ...] = (), *, without: Iterable[str] = (), default_texts: Mapping[str, str] | None = None
) -> Any:
    """Return the annotation of the parameter of a command that holds options, which `parse_options` reads.

    Args:
        stages: The names of the stages in `CleanOptions` whose options the command has; none for all.
        without: The names of options that it does not have.
        default_texts: By name of an option, the default that help shows instead of the usual text.
    """
    groups: list[tuple[str, Any, Any]] = []
    left_out, texts = set(without), default_texts or {}
    for each in fields(CleanOptions):
        if not stages or each.name in stages:
            options = [option for option in OPTIONS if option.stage == each.name and option.name not in left_out]
            arguments = [(option.name, *_build_argument(option, texts.get(option.name, ""))) for option in options]
            group = make_dataclass(type(each.default).__name__.removesuffix("Options"), arguments)
            group.__doc__ = type(each.default).__doc__
            help_texts = {"help": group.__doc__}  # without it, tyro searches the source for comments, which takes long
            groups.append((each.name, tyro.conf.OmitArgPrefixes[group], field(default_factory=group, metadata=help_texts)))
    arguments = tyro.conf.OmitArgPrefixes[make_dataclass("OptionArguments", groups)]
    return tyro.conf.arg(name="", prefix_name=False, constructor=arguments)


def parse_options(arguments: object) -> CleanOptions:
    """Return the options in the value of a parameter of `build_options_argument`. Raises OptionError."""
    given: dict[str, object] = {}
    for option in OPTIONS:
        value = getattr(getattr(arguments, option.stage, None), option.name, None)
        if value is None or value == _build_argument(option)[1]:
            continue
        if isinstance(value, bool | int | float):
            given[option.name] = option.from_display(value)
        else:
            given[option.name] = option.parse(cast("tuple[Any, ...]", value) if isinstance(value, tuple) else (value,))
    return build_clean_options(**given)


def _build_argument(option: Option, default_text: str = "") -> tuple[Any, Any]:
    """Return the annotation and the default value of the argument for an option."""
    details: dict[str, Any] = {"name": option.flag.removeprefix("--"), "help": option.help, "aliases": option.aliases or None}
    if option.name in PURPOSE_OPTIONS:  # None if it is not given
        lab = "" if option.lab_default is None else f"; with --purpose lab: {option.to_display(option.lab_default)}"
        details["help_behavior_hint"] = f"(default: {option.to_display(option.default)}{lab})"
        return Annotated[type(option.default) | None, tyro.conf.arg(metavar=option.metavar, **details)], None
    if default_text := default_text or option.default_text:
        details["help_behavior_hint"] = f"(default: {default_text})"
    if isinstance(option.default, bool):
        return Annotated[FlagOption, tyro.conf.arg(**details)], option.default
    argument = tyro.conf.arg(metavar=option.metavar, **details)
    if option.type == tuple[float, ...]:
        return Annotated[str, argument], ",".join(f"{number:g}" for number in option.to_display(option.default))
    if isinstance(option.default, tuple):
        element = Path if Path in get_args(get_args(option.type)[0]) else str
        return Annotated[tyro.conf.UseAppendAction[tuple[element, ...]], argument], ()
    if isinstance(option.default, float):
        return Annotated[float, argument], option.to_display(option.default)
    if isinstance(option.default, int | str):
        return Annotated[type(option.default), argument], option.default
    return Annotated[float | None if option.type == float | None else str | None, argument], None


def run_clean(
    takes: TakesArgument,
    options: Annotated[object, build_options_argument()],
    output_folder: Annotated[
        Path | None,
        describe_option("DIR", "folder for the output files", "TAKE.mocapfix/ beside the take", name="out", aliases=["-o"]),
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: Annotated[
        FlagOption, tyro.conf.arg(name="json", help="print the report only, as JSON (an array for several takes or subjects)")
    ] = False,
    clips: Annotated[
        Path | None, describe_option("FILE", "also write the --character with the motions of all takes as its animations", "none")
    ] = None,
) -> int:
    """Clean takes: correct labels, replace spikes, fill gaps.

    Writes the cleaned file, a BVH, the list of changes, a report and a before/after recording.
    """
    from mocapfix.cli.clean import clean_takes

    return clean_takes(takes, output_folder, parse_options(options), overwrite=overwrite, as_json=as_json, clips=clips)


def run_inspect(
    take: TakeArgument,
    options: Annotated[object, build_options_argument(("read", "subject"))],
    as_json: Annotated[FlagOption, tyro.conf.arg(name="json", help="print JSON (an array for several subjects)")] = False,
) -> int:
    """List the faults of a take: all that clean would detect. Writes nothing."""
    from mocapfix.cli.clean import inspect_take

    return inspect_take(take, parse_options(options), as_json)


def run_scene(
    scene: Annotated[
        str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE", help="a YAML file, or the name of a shipped scene")
    ],
    output_folder: Annotated[
        Path | None, describe_option("DIR", "folder for the output files", "SCENE.mocapfix/", name="out", aliases=["-o"])
    ] = None,
    overwrite: OverwriteOption = False,
) -> int:
    """Run a scene: clean takes as a job file describes, or estimate motion and camera from 2-D keypoints."""
    from mocapfix.cli.clean import SCENE_RUNNERS
    from mocapfix.io.shipped import find_shipped_folder, read_yaml

    shipped_folder = find_shipped_folder("scenes")
    path = Path(scene) if scene.endswith((".yaml", ".yml")) else shipped_folder / f"{Path(scene).name}.yaml"
    if path.parent == shipped_folder and not path.is_file():
        names = ", ".join(sorted(each.stem for each in shipped_folder.glob("*.yaml")))
        raise SceneError(f"There is no scene named {scene!r}; choose one of: {names}; or name a .yaml file.")
    kind = read_yaml(path).get("kind")
    if not isinstance(kind, str) or kind not in SCENE_RUNNERS:
        raise SceneError(f"{path}: kind: must be one of {', '.join(SCENE_RUNNERS)}, not {kind!r}.")
    return SCENE_RUNNERS[kind](path, output_folder or Path(f"{path.stem}.mocapfix"), overwrite)


def run_demo(
    output_folder: Annotated[
        Path, tyro.conf.arg(name="out", aliases=["-o"], metavar="DIR", help="folder for demo.c3d and demo.mocapfix/")
    ] = Path(),
    seed: Annotated[int, tyro.conf.arg(metavar="N", help="seed of the synthetic person, motion and damage")] = 0,
) -> int:
    """Clean a synthetic take and compare the errors with the known truth.

    The take shows a person who walks, reaches, crouches and turns; markers are missing, those of an arm among them, and have
    spikes. It is written as demo.c3d and cleaned like any other file; the output files are in demo.mocapfix/.
    """
    from mocapfix import pipeline
    from mocapfix.cli.clean import print_summary
    from mocapfix.io.files import make_output_folder
    from mocapfix.synthetic import compose_take, compute_fill_errors, write_synthetic_take

    make_output_folder(output_folder)
    truth, path = compose_take(seed=seed), output_folder / "demo.c3d"
    write_synthetic_take(path, truth)
    frame_count, marker_count = truth.marker_positions.shape[:2]
    console.stdout_console.print(
        f"Wrote {escape(str(path))}: {frame_count / truth.rate:.0f} s of {marker_count} markers, "
        f"{truth.missing_mask.sum()} samples missing."
    )
    with console.show_progress(path.name, needs_kernels=True) as progress:
        result = pipeline.clean(path, progress=progress)
        outputs = result.write(output_folder / "demo.mocapfix", overwrite=True, report_progress=progress)
    table = Table("root mean square error, mm", title="Compared with the known truth", title_justify="left")
    errors_mm = compute_fill_errors(truth, result)
    for method in errors_mm:
        table.add_column(method, justify="right")
    for damage in errors_mm["mocapfix"]:
        table.add_row(damage, *(f"{of_method[damage]:.1f}" for of_method in errors_mm.values()))
    console.stdout_console.print(table)
    print_summary(json.loads(outputs["report.json"].read_text(encoding="utf-8")), outputs)
    console.print_line(f"  To see the recording: mocapfix view {escape(str(output_folder / 'demo.mocapfix'))}")
    return console.EXIT_DONE


def run_view(
    recording: Annotated[
        Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR|FILE.rrd", help="output folder of clean, or a recording in it")
    ],
) -> int:
    """Show a take before and after cleaning in the rerun viewer."""
    files = sorted(recording.glob("*.rrd")) if recording.is_dir() else [recording]
    if not files or not all(file.is_file() and file.suffix == ".rrd" for file in files):
        raise ReadError(f"{recording}: holds no recording (.rrd); name the output folder of clean, or a recording in it.")
    done = subprocess.run([sys.executable, "-m", "rerun", "--bind", "127.0.0.1", *map(str, files)], check=False)
    if done.returncode:
        raise ReadError(f"{files[0]}: rerun could not show it (exit {done.returncode}); check that this machine has a display.")
    return console.EXIT_DONE


REVIEW_PACKAGES = ("nicegui", "starlette", "uvicorn")

FolderArgument = Annotated[
    Path,
    tyro.conf.Positional,
    tyro.conf.arg(metavar="DIR", help="output folder of `mocapfix clean` or `mocapfix batch`; of `review` also a take"),
]


def run_review(
    folder: FolderArgument,
    *,
    take: Annotated[str | None, describe_option("NAME", "open this take first", "the first that is not approved")] = None,
    port: Annotated[int, tyro.conf.arg(metavar="N", help="port on this computer; 0 for any free one")] = 0,
    reviewer: Annotated[str | None, describe_option("NAME", "who decides; noted with each decision", "the user's name")] = None,
    browser: Annotated[bool, tyro.conf.arg(help="open the page in the browser")] = True,
) -> int:
    """Review the changes to cleaned takes in the browser: see each where it happened, and accept or reject it with a key.

    A take that is not cleaned is shown with a preview at once, and cleaned in full behind it; decisions made until then are kept.
    The page is served to this computer only. Every decision is saved at once in the changes file of the take.
    """
    if missing := [name for name in REVIEW_PACKAGES if importlib.util.find_spec(name) is None]:
        raise ReadError(f"The review needs {' and '.join(missing)}; install it with: pip install 'mocapfix[review]'.")
    from mocapfix.batch.records import BATCH_LOCK_NAME
    from mocapfix.io.files import hold_process_lock
    from mocapfix.review.review_session import ReviewSession, describe_other_review
    from mocapfix.review.server import ReviewServer, find_three_module

    find_three_module()  # raises ReadError if it is not installed
    folder, is_file = (clean_preview(folder), True) if folder.is_file() else (folder, False)
    with suppress(KeyError, OSError, ImportError):  # a user without a name
        reviewer = getpass.getuser() if reviewer is None else reviewer
    session = ReviewSession(folder, reviewer or "")
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
        if is_file and session.open_take(session.ids[0]).take.options.initialise.is_fast:
            session.start_cleaning(session.ids[0], {})
        server = ReviewServer(session, port)
        console.print_line(f"Review of {escape(str(folder))}: {escape(server.address + start)}")
        console.print_line("End it with Ctrl-C, or by closing the page.")
        console.stdout_console.file.flush()
        if browser:
            webbrowser.open(server.address + start)
        try:
            server.serve()
        except KeyboardInterrupt:
            console.print_line("The review has ended; every decision is saved.")
    return console.EXIT_DONE


def clean_preview(take: Path) -> Path:
    """Return the folder of the outputs of a take; if it has none, those of a preview are written. Raises MocapfixError."""
    from mocapfix import pipeline
    from mocapfix.cli.clean import ANIMATION_SUFFIXES, choose_output_folder

    folder, has_markers = choose_output_folder(take), take.suffix.lower() not in ANIMATION_SUFFIXES
    if not list(folder.glob(f"*{JSON_REPORT_SUFFIX}")):
        with console.show_progress(take.name, needs_kernels=has_markers) as progress:
            pipeline.clean(take, is_fast=has_markers, progress=progress).write(folder, report_progress=progress)
    return folder


def run_status(folder: FolderArgument, as_json: JsonOption = False) -> int:
    """List the cleaned takes in a folder, and how far the review of each is."""
    from mocapfix.review.review_session import describe_take
    from mocapfix.review.take_files import find_cleaned_takes

    takes = [describe_take(take) for take in find_cleaned_takes(folder)]
    if as_json:
        console.print_json(takes)
        return console.EXIT_DONE
    table = Table("Take", "State", "Changes", "Reviewed", "Worst, mm", "Approved")
    for each in takes:
        worst = "" if each["worst_mm"] is None else f"{each['worst_mm']:.1f}"
        approved = f"{each['approved_by']}, {each['approved_at'][:16].replace('T', ' ')}" if each["approved_by"] else ""
        counts = (str(each["change_count"]), str(each["reviewed_count"]))
        table.add_row(escape(each["id"]), "unreadable" if each["error"] else each["state"], *counts, worst, escape(approved))
    console.stdout_console.print(table)
    for each in takes:
        if each["error"]:
            console.print_error(each["error"])
    return console.EXIT_FAILED if any(each["error"] for each in takes) else console.EXIT_DONE


# The commands, with the module and the function of each: one command needs not those of the others.
COMMANDS = {
    "demo": "mocapfix.cli.commands.run_demo",
    "inspect": "mocapfix.cli.commands.run_inspect",
    "label": "mocapfix.cli.marker_sets.run_label",
    "calibrate": "mocapfix.cli.marker_sets.run_calibrate",
    "clean": "mocapfix.cli.commands.run_clean",
    "batch": "mocapfix.cli.batch.run_batch",
    "view": "mocapfix.cli.commands.run_view",
    "review": "mocapfix.cli.commands.run_review",
    "status": "mocapfix.cli.commands.run_status",
    "run": "mocapfix.cli.commands.run_scene",
}
# The groups of commands, with their help and their table. Only their own commands need the modules of `lab`.
COMMAND_GROUPS = {
    "marker-set": ("List and show marker sets, and learn new ones from takes.", "mocapfix.cli.marker_sets.MARKER_SET_COMMANDS"),
    "bench": ("Measure mocapfix against known truth.", "mocapfix.lab.command.BENCH_COMMANDS"),
    "train": ("Train the pose priors and the twist model on motion.", "mocapfix.lab.train_command.TRAIN_COMMANDS"),
}


def parse_all_commands(arguments: list[str]) -> int:
    """Run a command by the parser that knows all of them: it prints help, and which of them an argument is for."""
    app = tyro.extras.SubcommandApp()
    for name, function in COMMANDS.items():
        app.command(name=name)(resolve_name(function))
    for group_name, (help_text, table) in COMMAND_GROUPS.items():
        group = tyro.extras.SubcommandApp()
        if not table.startswith("mocapfix.lab") or arguments[:1] == [group_name]:
            for name, command in resolve_name(table).items():
                group.command(name=name)(command)
        app.command(group, name=group_name, help=help_text)
    return app.cli(
        prog="mocapfix",
        description="Clean optical motion capture: writes the cleaned file, a BVH, a report and a before/after recording. "
        "--version prints the version. After an unexpected error, --debug shows where in mocapfix it was raised.",
        args=arguments,
    )
