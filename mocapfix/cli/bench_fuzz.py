"""The command `mocapfix bench fuzz`: damaged files, strange takes and killed runs."""

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import tyro
from rich.markup import escape

from mocapfix.cli.arguments import FlagOption, JsonOption
from mocapfix.cli.console import EXIT_DONE, EXIT_FAILED, print_json, print_line, print_usage_error, show_progress

QUICK_CASE_COUNTS = {"readers": 1000, "c3d": 1000, "characters": 200, "cleans": 10, "kills": 10}
CASE_COUNTS = {"readers": 10_000, "c3d": 100_000, "characters": 5000, "cleans": 200, "kills": 200}


def run_bench_fuzz(
    what: Annotated[
        Literal["readers", "c3d", "characters", "cleans", "kills"],
        tyro.conf.Positional,
        tyro.conf.arg(
            help="readers: damaged files; c3d: generated C3D files, compared with ezc3d; characters: damaged characters; "
            "cleans: strange takes; "
            "kills: clean --overwrite, killed at random moments"
        ),
    ],
    count: Annotated[int | None, tyro.conf.arg(metavar="N", help="number of cases")] = None,
    seed: Annotated[int, tyro.conf.arg(metavar="N", help="seed of the first case; each case has the next seed")] = 0,
    files: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="captures that are damaged, in place of small generated files")
    ] = None,
    findings: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help="folder for the inputs of findings")] = None,
    quick: Annotated[FlagOption, tyro.conf.arg(help="few cases: done in a minute")] = False,
    as_json: JsonOption = False,
) -> int:  # fmt: skip
    """Try to break mocapfix: each case must end in a result or in one sentence, within limits of time and memory.

    The status is 1 if one does not.
    """
    cases = count if count is not None else (QUICK_CASE_COUNTS if quick else CASE_COUNTS)[what]
    if cases < 1:
        return print_usage_error(f"bench fuzz: --count must be at least 1, not {cases}.")
    with show_progress(f"fuzz {what}") as progress:
        if what == "kills":
            from mocapfix.bench.kill_clean import measure_kills

            with TemporaryDirectory() as folder:
                results: Mapping[str, Any] = measure_kills(Path(folder), cases, seed, progress)
            is_sound = not (results["broken_outputs"] or results["changed_inputs"] or results["left_behind"])
        else:
            from mocapfix.bench.fuzz_process import run_cases

            if what == "readers":
                from mocapfix.bench.fuzz_readers import READER_FUZZ_LIMITS as limits
                from mocapfix.bench.fuzz_readers import build_folder_builder, build_reader_case

                build_case = build_folder_builder(files) if files else build_reader_case
            elif what == "c3d":
                from mocapfix.bench.fuzz_c3d import C3D_FUZZ_LIMITS as limits
                from mocapfix.bench.fuzz_c3d import build_c3d_case as build_case
            elif what == "characters":
                from mocapfix.bench.fuzz_characters import build_character_case as build_case
                from mocapfix.bench.fuzz_readers import READER_FUZZ_LIMITS as limits
            else:
                from mocapfix.bench.fuzz_cleans import CLEAN_FUZZ_LIMITS as limits
                from mocapfix.bench.fuzz_cleans import build_clean_case as build_case
            results = run_cases(build_case, range(seed, seed + cases), limits, findings, progress).to_json()
            is_sound = not results["findings"]
    status = EXIT_DONE if is_sound else EXIT_FAILED
    if as_json:
        print_json(results)
        return status
    for key, value in results.items():
        if key != "findings":
            print_line(f"{key.replace('_', ' ')}: {value}")
    for each in results.get("findings", ()):
        print_line(f"seed {each['seed']}: {each['kind']}: {escape(each['text'].splitlines()[-1])}")
    return status
