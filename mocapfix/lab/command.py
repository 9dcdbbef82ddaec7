"""The commands `mocapfix bench ...` by name.

The commands `mocapfix bench ...`: measure mocapfix against known truth.

The commands `mocapfix bench batch` and `mocapfix bench batch-kills`: speed and safety of batches.

The command `mocapfix bench fuzz`: damaged files, strange takes and killed runs.

The command `mocapfix bench labels`: labels taken away and found again.

The command `mocapfix bench stress`: extreme motion with known truth.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal, cast

import tyro
from rich.markup import escape
from rich.table import Table

from mocapfix.cli.arguments import FlagOption, JsonOption
from mocapfix.cli.console import EXIT_DONE, EXIT_FAILED, print_json, print_line, print_usage_error, show_progress, stdout_console
from mocapfix.lab.conventions import run_bench_conventions
from mocapfix.lab.method_commands import (
    run_bench_contacts,
    run_bench_hands,
    run_bench_hybrik,
    run_bench_learned_ik,
    run_bench_prior,
    run_bench_retarget,
    run_bench_review,
    run_bench_session,
)

FAULT_COLUMNS = (
    ("recall", "detected", ".0%"),
    ("overlap", "overlap", ".0%"),
    ("false_alarms_per_minute", "false alarms per minute", ".1f"),
    ("predicted_mm", "predicted error, mm", ".1f"),
    ("true_mm", "true error, mm", ".1f"),
)  # key of a result, heading and number format
CLEAN_COLUMNS = (
    ("seconds", "seconds", ".1f"),
    ("cpu_seconds", "processor seconds", ".1f"),
    ("seconds_per_second", "seconds per second of motion", ".3f"),
    ("over_solver", "relative to the solver", ".1f"),
    ("peak_mb", "peak memory, MB", ".0f"),
    ("moved_mended", "displaced samples repaired", ".1%"),
    ("error_mm", "marker error, mm", ".2f"),
)
MotionFolderOption = Annotated[
    Path | None,
    tyro.conf.arg(metavar="FOLDER", help="CMU motion, of whose test subjects takes are made; by default takes are synthetic"),
]
BASELINE_UPDATE_RUNS = 3  # cleans of each file whose median a new baseline has


def run_bench_solver(
    as_json: JsonOption = False,
    quick: Annotated[FlagOption, tyro.conf.arg(help="take few timings: done in seconds, less accurate")] = False,
) -> int:
    """Time the solver: compared with scipy on a task with known truth, and with a dense solver on SCOPE's experiments."""
    from mocapfix.lab.compared_solvers import measure_in_fresh_process

    with show_progress("solver"):
        results = measure_in_fresh_process(quick)
    if as_json:
        print_json(results)
        return EXIT_DONE
    stdout_console.print(build_common_task_table(results))
    stdout_console.print(build_experiment_table(results["experiments"]))
    for joint_count, time_us in results["direction_us"].items():
        dense_us = results["dense_direction_us"][joint_count]
        stdout_console.print(f"One search direction with {joint_count} joints: {time_us:.1f} us; dense {dense_us:.0f} us.")
    stdout_console.print(
        f"51 joints take {results['k51_over_k23']:.2f} times as long as 23; dense {results['dense_k51_over_k23']:.2f} times."
    )
    return EXIT_DONE


def build_common_task_table(results: Mapping[str, Any]) -> Table:
    """Return the speed and accuracy on the task that scipy solves too."""
    title = f"600 frames, 53 markers, 31 joints; {results['threads']} threads"
    table = Table("common task", "clean", "noisy", title=title)
    for key, heading, number_format in (
        ("fps_one_thread", "frames per second, one thread", ",.0f"),
        ("fps_all_threads", "frames per second, all threads", ",.0f"),
        ("scipy_fps", f"frames per second, scipy, {results['scipy_frames']} frames", ",.0f"),
        ("over_scipy", "speed relative to scipy, one thread", ".0f"),
        ("joint_error_mm", "joint error, mm", ".2f"),
    ):
        table.add_row(heading, *(format(results[key][name], number_format) for name in ("clean", "noisy")))
    return table


def build_experiment_table(rows: Iterable[Mapping[str, Any]]) -> Table:
    """Return the times of SCOPE's experiments."""
    table = Table("experiment", "joints", "measurements", "shape parameters", "us", "dense, us", "speed-up")
    for row in rows:
        table.add_row(
            *(str(row[key]) for key in ("experiment", "joints", "measured", "shapes")),
            *(f"{row[key]:.1f}" for key in ("sparse_us", "dense_us", "speedup")),
        )
    return table


def run_bench_uncertainty(
    data: MotionFolderOption = None,
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="number of takes")] = 8,
    known_subject: Annotated[
        FlagOption, tyro.conf.arg(help="calibrate the subject from another take of the same person")
    ] = False,
    as_json: JsonOption = False,
) -> int:  # fmt: skip
    """Compare predicted standard deviations with the true errors of synthetic takes."""
    from mocapfix.lab.uncertainty import measure_uncertainty

    if takes < 1:
        return print_usage_error(f"bench uncertainty: --takes must be at least 1, not {takes}.")
    with show_progress("uncertainty") as progress:
        results: Mapping[str, Any] = measure_uncertainty(
            range(takes), data, is_subject_known=known_subject, report_progress=progress
        )
    if as_json:
        print_json(results)
        return EXIT_DONE
    table = Table("per axis", "samples", "error, mm", "predicted SD, mm", "within 1 SD", "within 2 SD")
    for key, heading in (("joints", "joints"), ("filled_markers", "filled markers")):
        groups = {**results[key]["by"], **results[key].get("by_joint", {})}
        for part, row in ((f"[bold]{heading}[/]", results[key]), *groups.items()):
            errors = (f"{row['error_mm']:.1f}", f"{row['deviation_mm']:.1f}")
            table.add_row(part, str(row["samples"]), *errors, f"{row['within_1_sigma']:.0%}", f"{row['within_2_sigma']:.0%}")
        table.add_section()
    stdout_console.print(table)
    stdout_console.print("Of a normal distribution, 68 % lie within one standard deviation (SD) and 95 % within two.")
    return EXIT_DONE


def run_bench_calibration(as_json: JsonOption = False) -> int:
    """Compare calibrated bones, marker offsets and joints with the truth of synthetic people with asymmetric bones."""
    from mocapfix.lab.calibration import measure_calibration

    with show_progress("calibration"):
        rows = cast("list[Any]", measure_calibration())
    if as_json:
        print_json({"people": rows[:-1], "mean": rows[-1]})
        return EXIT_DONE
    table = Table("mean error, mm", "bones", "marker offsets", "joints", "average body: bones", "marker offsets", "joints")
    keys = [f"{body}{quantity}_mm" for body in ("", "average_") for quantity in ("bones", "offsets", "joints")]
    for row in rows:
        table.add_row(str(row["person"]), *(f"{row[key]:.1f}" for key in keys))
    stdout_console.print(table)
    return EXIT_DONE


def run_bench_faults(
    data: MotionFolderOption = None,
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="number of takes for each kind of fault")] = 6,
    short: Annotated[FlagOption, tyro.conf.arg(help="inject several kinds into each of a few composed takes")] = False,
    as_json: JsonOption = False,
) -> int:  # fmt: skip
    """Inject faults of every kind into sound takes with known truth, clean them, and score detection and repair."""
    from mocapfix.lab.fault_detection import measure_fault_detection, measure_mixed_faults

    with show_progress("faults") as progress:
        rows = measure_mixed_faults(progress) if short else measure_fault_detection(data, takes, progress)
    results = cast("Mapping[str, Any]", rows)
    if as_json:
        print_json(results)
        return EXIT_DONE
    table = Table("kind", *(heading for _, heading, _ in FAULT_COLUMNS))
    for kind, row in results.items():
        if kind == "all":
            table.add_section()
        cells = ("" if row[key] is None else format(row[key], number_format) for key, _, number_format in FAULT_COLUMNS)
        table.add_row(kind, *cells)
    stdout_console.print(table)
    stdout_console.print("The false alarms in the last row are those in the same takes without injected faults.")
    return EXIT_DONE


def run_bench_files(as_json: JsonOption = False) -> int:
    """Time reading and writing of files: one minute of 53 markers at 120 Hz."""
    from mocapfix.lab.clean_speed import FILE_REPEATS, measure_file_speed

    with show_progress("files"):
        rows: list[Any] = list(measure_file_speed())
    if as_json:
        print_json(rows)
        return EXIT_DONE
    table = Table("operation", "frames", f"ms (median of {FILE_REPEATS})")
    for row in rows:
        table.add_row(row["what"], str(row["frames"]), f"{row['ms']:.1f}")
    stdout_console.print(table)
    return EXIT_DONE


def run_bench_animations(
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="CMU motion of the test subjects; by default motion is synthetic")
    ] = None,
    trials: Annotated[int, tyro.conf.arg(metavar="N", help="number of trials for each kind of fault")] = 12,
    seed: Annotated[int, tyro.conf.arg(metavar="N", help="seed of the injected faults")] = 0,
    as_json: JsonOption = False,
) -> int:
    """Inject pops, flips, jitter and gaps into sound animations, clean them, and compare with linear interpolation."""
    from mocapfix.lab.animation_repair import measure_animation_repair

    with show_progress("animations") as progress:
        results = cast("Mapping[str, Any]", measure_animation_repair(data, trials, seed, progress))
    if as_json:
        print_json(results)
        return EXIT_DONE
    methods = ("known", "detected")  # the repair of known and of detected faults
    headings = ("repaired, faults known", "repaired, faults detected", "relative to linear: known", "detected")
    table = Table("joint error, mm", "faults", "detected", "linear", *headings)
    for kind, rows in results["rows"].items():
        for length, row in rows.items():
            errors = [f"{row[f'{method}_mm']:.1f}" for method in ("linear", *methods)]
            ratios = [f"{row[f'{method}_over_linear']:.2f}" for method in methods]
            table.add_row(f"{kind}, {length}", str(row["faults"]), f"{row['detected_share']:.0%}", *errors, *ratios)
    table.add_section()
    for length, row in results["pooled"].items():
        table.add_row(f"all, {length}", "", "", "", "", "", *(f"{row[method]:.2f}" for method in methods if row))
    stdout_console.print(table)
    alarms = ", ".join(f"{kind} {count:.1f}" for kind, count in results["alarms_per_minute"].items()) or "none"
    stdout_console.print(f"Short: 0.2 to 0.5 s; long: 0.5 to 1 s. False alarms per minute in the sound trials: {alarms}.")
    stdout_console.print(f"Sound samples that were changed: {results['changed_share']:.2%}.")
    return EXIT_DONE


def run_bench_clean(
    runs: Annotated[int, tyro.conf.arg(metavar="N", help="number of cleans of each file; the median counts")] = 3,
    as_json: JsonOption = False,
) -> int:
    """Time whole cleans of composed files, relative to the solver, and measure their memory.

    sound: a minute with few gaps and spikes; tenth_missing: 45 s with a tenth of the samples missing; heavily_damaged: 13 s with
    13 % missing and 6 % displaced; animation: 43 s of BVH with pops and jitter.
    """
    from mocapfix.lab.clean_speed import measure_clean_speed

    if runs < 1:
        return print_usage_error(f"bench clean: --runs must be at least 1, not {runs}.")
    with show_progress("clean") as progress:
        costs = measure_clean_speed(runs, progress)
    if as_json:
        print_json(costs)
        return EXIT_DONE
    table = Table("file", *(heading for _, heading, _ in CLEAN_COLUMNS))
    for name, cost in costs.items():
        table.add_row(name, *(format(cost[key], number_format) if key in cost else "" for key, _, number_format in CLEAN_COLUMNS))
    stdout_console.print(table)
    stdout_console.print("Relative to the solver: processor time for a second of motion, over that of the solver alone.")
    return EXIT_DONE


def run_bench_baseline(
    file: Annotated[Path | None, tyro.conf.arg(metavar="FILE.json", help="baseline; by default the shipped one")] = None,
    update: Annotated[FlagOption, tyro.conf.arg(help="write the measured values as the new baseline")] = False,
    as_json: JsonOption = False,
) -> int:
    """Compare accuracy and speed with a baseline; the status is 1 if anything became worse than its tolerance.

    `mocapfix bench --baseline` is the same.
    """
    from mocapfix.lab import baseline
    from mocapfix.lab.common_task import find_bench_file

    path = file or find_bench_file("baseline.json")
    known = {} if update else baseline.read_baseline(path)
    with show_progress("baseline") as progress:
        measured = baseline.measure_baseline(progress, BASELINE_UPDATE_RUNS if update else 1)
        measured = baseline.repeat_slow_cleans(measured, known, progress)
    if update:
        baseline.write_baseline(path, measured)
        stdout_console.print(f"Wrote {len(measured)} values to {path}.")
        return EXIT_DONE
    rows = baseline.compare_with_baseline(measured, known)
    is_worse = any(row.is_worse for row in rows)
    if as_json:
        print_json([row.to_json() for row in rows])
        return EXIT_FAILED if is_worse else EXIT_DONE
    table = Table("quantity", "baseline", "now", "worse by", "allowed", "")
    for row in rows:
        values = (format(number, ".4g") for number in (row.baseline, row.value, row.change, row.allowed_change))
        table.add_row(row.name, *values, "[bold red]worse[/]" if row.is_worse else "")
    stdout_console.print(table)
    if unknown := [name for name in measured if name not in known]:
        stdout_console.print(f"Not in the baseline: {', '.join(unknown)}. Add them with --update.")
    return EXIT_FAILED if is_worse else EXIT_DONE


def run_bench_batch(
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="composed takes")] = 20,
    shortest: Annotated[float, tyro.conf.arg(metavar="SECONDS", help="length of the shortest take")] = 10.0,
    longest: Annotated[float, tyro.conf.arg(metavar="SECONDS", help="length of the longest take")] = 20.0,
    workers: Annotated[int, tyro.conf.arg(metavar="N", help="workers")] = 2,
    as_json: JsonOption = False,
) -> int:
    """Compare a batch with cleaning the same takes in one process: rate, memory of the workers, overhead for each take."""
    from mocapfix.lab.batches import measure_batch_speed

    with TemporaryDirectory(prefix="mocapfix-") as folder, show_progress("batch", needs_kernels=True) as progress:
        result = measure_batch_speed(Path(folder), takes, (shortest, longest), workers, progress)
    if as_json:
        print_json(asdict(result) | {"rate_share": result.rate_share})
    else:
        table = Table("", "value")
        for name, value in (asdict(result) | {"rate_share": result.rate_share}).items():
            table.add_row(name, str(value))
        stdout_console.print(table)
    return EXIT_DONE if result.differing == 0 else EXIT_FAILED


def run_bench_batch_kills(
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="short composed takes")] = 60,
    kills: Annotated[int, tyro.conf.arg(metavar="N", help="how often a worker is killed")] = 5,
    workers: Annotated[int, tyro.conf.arg(metavar="N", help="workers")] = 2,
    seed: Annotated[int, tyro.conf.arg(metavar="N", help="seed of the moments")] = 0,
    as_json: JsonOption = False,
) -> int:
    """Kill workers, the scheduler and the client of a batch at random moments, and compare its outputs with a quiet run."""
    from mocapfix.lab.batches import measure_chaos

    with TemporaryDirectory(prefix="mocapfix-") as folder, show_progress("batch", needs_kernels=True) as progress:
        result = measure_chaos(Path(folder), takes, kills, workers, seed, progress)
    if as_json:
        print_json(asdict(result) | {"is_sound": result.is_sound})
    else:
        print_line(f"{result.done_count} of {result.take_count} takes done in {result.seconds:.0f} s; killed: {result.kills}.")
        print_line(f"Takes by attempts: {result.attempts}; outputs that differ from the quiet run: {len(result.differing)}.")
        for error in result.client_errors:
            print_line(f"A client ended with: {error}")
    return EXIT_DONE if result.is_sound else EXIT_FAILED


BATCH_BENCH_COMMANDS = {"batch": run_bench_batch, "batch-kills": run_bench_batch_kills}


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
            from mocapfix.lab.fuzz_process import measure_kills

            with TemporaryDirectory() as folder:
                results: Mapping[str, Any] = measure_kills(Path(folder), cases, seed, progress)
            is_sound = not (results["broken_outputs"] or results["changed_inputs"] or results["left_behind"])
        else:
            from mocapfix.lab.fuzz_process import run_cases

            if what == "readers":
                from mocapfix.lab.fuzz_readers import READER_FUZZ_LIMITS as limits
                from mocapfix.lab.fuzz_readers import build_folder_builder, build_reader_case

                build_case = build_folder_builder(files) if files else build_reader_case
            elif what == "c3d":
                from mocapfix.lab.fuzz_c3d import C3D_FUZZ_LIMITS as limits
                from mocapfix.lab.fuzz_c3d import build_c3d_case as build_case
            elif what == "characters":
                from mocapfix.lab.fuzz_characters import build_character_case as build_case
                from mocapfix.lab.fuzz_readers import READER_FUZZ_LIMITS as limits
            else:
                from mocapfix.lab.fuzz_readers import CLEAN_FUZZ_LIMITS as limits
                from mocapfix.lab.fuzz_readers import build_clean_case as build_case
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


LABEL_COLUMNS = (
    ("takes", "takes", ".0f"),
    ("tracklets", "tracklets", ".0f"),
    ("purity", "purity", ".5f"),
    ("recall", "recall", ".4f"),
    ("precision", "precision", ".4f"),
    ("f1", "F1", ".4f"),
    ("worst_f1", "worst F1", ".4f"),
    ("seconds_per_second", "processor seconds per second", ".2f"),
)
"""key of a result, heading and number format"""


def run_bench_labels(
    data: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FOLDER", help="labelled C3D files of whole bodies; by default takes are composed"),
    ] = None,
    seed: Annotated[int, tyro.conf.arg(metavar="N", help="seed of the damage")] = 0,
    as_json: JsonOption = False,
) -> int:
    """Take the labels of takes away, label them again by their marker set, and score the labels.

    tracks: every trajectory a column. ghosts: with points that are no markers. cloud: the points of each frame in random order.
    noise: random occlusions and ghosts in each frame. broken: the same with broken trajectories. two people: clouds of two takes.
    """
    from mocapfix.lab.label_recovery import measure_label_recovery, summarise_label_scores

    with show_progress("labels") as progress:
        scores = measure_label_recovery(data, seed, progress)
    if as_json:
        print_json([asdict(score) for score in scores])
        return EXIT_DONE
    table = Table("kind", *(heading for _, heading, _ in LABEL_COLUMNS))
    for kind, row in summarise_label_scores(scores).items():
        table.add_row(kind, *(format(row[key], number_format) for key, _, number_format in LABEL_COLUMNS))
    stdout_console.print(table)
    stdout_console.print("Purity: the share of the points whose tracklet mostly shows the same marker.")
    return EXIT_DONE


QUICK_MOTIONS = ("straight arm", "kick", "cartwheel")
QUICK_RATES_HZ = (120.0,)


def run_bench_stress(
    data: Annotated[
        tuple[Path, ...], tyro.conf.arg(metavar="FOLDER", help="folders of motion with test.npz, whose fastest tenth is used")
    ] = (),
    quick: Annotated[FlagOption, tyro.conf.arg(help=f"only {', '.join(QUICK_MOTIONS)} at {QUICK_RATES_HZ[0]:g} Hz")] = False,
    as_json: JsonOption = False,
) -> int:  # fmt: skip
    """Clean strikes, kicks, throws and acrobatics with known truth: limbs lost in sight, joint errors, sound samples changed.

    The status is 1 if a limit is exceeded.
    """
    from mocapfix.lab.extreme_motions import EXTREME_MOTIONS
    from mocapfix.lab.stress import MAX_ERROR_RATIO, MAX_LIMB_ERROR_M, STRESS_RATES_HZ, measure_stress

    motions, rates_hz = (QUICK_MOTIONS, QUICK_RATES_HZ) if quick else (tuple(EXTREME_MOTIONS), STRESS_RATES_HZ)
    with show_progress("stress") as progress:
        results: Mapping[str, Any] = measure_stress(data, motions, rates_hz, progress)
    totals = results["all"]
    status = EXIT_DONE if totals["within_limits"] else EXIT_FAILED
    if as_json:
        print_json(results)
        return status
    headings = (
        "frames lost in sight",
        "joint error, mm",
        "over ordinary",
        "largest of a seen limb, mm",
        "where",
        "changed",
        "poor",
    )
    table = Table("take", *headings)
    for row in results["takes"]:
        lost = ", ".join(f"{part} {count}" for part, count in row["lost_in_sight"].items()) or "0"
        errors = (f"{row['joint_error_mm']:.1f}", f"{row['over_ordinary']:.2f}", f"{row['limb_error_mm']:.0f}")
        name = f"{row['name']} (ordinary)" if row["ordinary"] and row["kind"] == "performed" else row["name"]
        where = f"{row['limb']}, frame {row['frame']}"
        table.add_row(name, lost, *errors, where, f"{row['changed_share']:.3%}", str(row["poor_frames"]))
    table.add_section()
    errors = ("", f"{totals['over_ordinary']:.2f}", f"{totals['limb_error_mm']:.0f}")
    table.add_row("all", str(totals["lost_frames"]), *errors, "", f"{totals['changed_share']:.3%}", str(totals["poor_frames"]))
    stdout_console.print(table)
    stdout_console.print(
        f"Limits: no frame lost in sight, {1e3 * MAX_LIMB_ERROR_M:.0f} mm for a joint of a limb whose markers are all seen, "
        f"{MAX_ERROR_RATIO:g} times the joint error of ordinary motion on average. Frames are counted from 0."
    )
    if results["skipped"]:
        stdout_console.print(f"Skipped: {results['skipped']}.")
    return status


BENCH_COMMANDS = {
    "baseline": run_bench_baseline,
    **BATCH_BENCH_COMMANDS,
    "clean": run_bench_clean,
    "solver": run_bench_solver,
    "uncertainty": run_bench_uncertainty,
    "calibration": run_bench_calibration,
    "review": run_bench_review,
    "stress": run_bench_stress,
    "faults": run_bench_faults,
    "labels": run_bench_labels,
    "fuzz": run_bench_fuzz,
    "files": run_bench_files,
    "animations": run_bench_animations,
    "hybrik": run_bench_hybrik,
    "prior": run_bench_prior,
    "retarget": run_bench_retarget,
    "session": run_bench_session,
    "contacts": run_bench_contacts,
    "conventions": run_bench_conventions,
    "hands": run_bench_hands,
    "learned-ik": run_bench_learned_ik,
}
