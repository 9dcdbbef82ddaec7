"""The commands `mocapfix bench ...`: measure mocapfix against known truth, and repeat the experiments of papers."""

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import tyro
from rich.markup import escape

from mocapfix.cli.commands import FlagOption, JsonOption, TakesArgument, describe_option
from mocapfix.cli.console import EXIT_DONE, EXIT_FAILED, print_line, print_usage_error, show_progress
from mocapfix.lab.results import print_results
from mocapfix.lab.train_command import FolderLists
from mocapfix.options import CHARACTER_PRESETS

MotionFolderOption = Annotated[
    Path | None, tyro.conf.arg(metavar="FOLDER", help="motion with the test subjects; by default motion is composed")
]
UnseenPosesOption = Annotated[
    Path | None, tyro.conf.arg(metavar="FOLDER", help="motion with the test subjects; by default 1,000 shipped poses of theirs")
]
CapturesOption = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help="captures to be measured instead, or as well")]
TakeCountOption = Annotated[int, tyro.conf.arg(metavar="N", help="number of takes")]
SeedOption = Annotated[int, tyro.conf.arg(metavar="N", help="seed of the random numbers")]
WorkersOption = Annotated[int, tyro.conf.arg(metavar="N", help="workers")]
BASELINE_UPDATE_RUNS = 3  # cleans of each file whose median a new baseline has
QUICK_CASE_COUNTS = {"readers": 1000, "c3d": 1000, "characters": 200, "cleans": 10, "kills": 10}
CASE_COUNTS = {"readers": 10_000, "c3d": 100_000, "characters": 5000, "cleans": 200, "kills": 200}
QUICK_MOTIONS = ("straight arm", "kick", "cartwheel")
QUICK_RATES_HZ = (120.0,)


def run_bench_baseline(
    file: Annotated[Path | None, tyro.conf.arg(metavar="FILE.json", help="baseline; by default the shipped one")] = None,
    update: Annotated[FlagOption, tyro.conf.arg(help="write the measured values as the new baseline")] = False,
    as_json: JsonOption = False,
) -> int:
    """Compare accuracy and speed with a baseline; the status is 1 if anything became worse than its tolerance.

    `mocapfix bench --baseline` is the same.
    """
    from mocapfix.lab import baseline
    from mocapfix.lab.sound_takes import find_bench_file

    path = file or find_bench_file("baseline.json")
    known = {} if update else baseline.read_baseline(path)
    with show_progress("baseline") as progress:
        measured = baseline.measure_baseline(progress, BASELINE_UPDATE_RUNS if update else 1)
        measured = baseline.repeat_slow_cleans(measured, known, progress)
    if update:
        baseline.write_baseline(path, measured)
        print_line(f"Wrote {len(measured)} values to {escape(str(path))}.")
        return EXIT_DONE
    rows = [row.to_json() for row in baseline.compare_with_baseline(measured, known)]
    print_results(rows, as_json)
    if not as_json:
        for row in rows:
            if row["is_worse"]:
                print_line(f"[bold red]Worse:[/] {escape(str(row['name']))}.")
        if unknown := [name for name in measured if name not in known]:
            print_line(f"Not in the baseline: {escape(', '.join(unknown))}. Add them with --update.")
    return EXIT_FAILED if any(row["is_worse"] for row in rows) else EXIT_DONE


def run_bench_clean(
    runs: Annotated[int, tyro.conf.arg(metavar="N", help="number of cleans of each file; the median counts")] = 3,
    as_json: JsonOption = False,
) -> int:
    """Time whole cleans of composed files, relative to the solver, and measure their memory.

    sound: a minute with few gaps and spikes; tenth_missing: 45 s with a tenth of the samples missing; heavily_damaged: 13 s with
    13 % missing and 6 % displaced; animation: 43 s of BVH with pops and jitter. Relative to the solver is the processor time for
    a second of motion, over that of the solver alone.
    """
    from mocapfix.lab.clean_speed import measure_clean_speed

    if runs < 1:
        return print_usage_error(f"bench clean: --runs must be at least 1, not {runs}.")
    with show_progress("clean") as progress:
        costs = measure_clean_speed(runs, progress)
    rows = {key: {name: cost.get(key) for name, cost in costs.items()} for key in next(iter(costs.values()))}
    return print_results(costs if as_json else rows, as_json)


def run_bench_solver(
    as_json: JsonOption = False,
    quick: Annotated[FlagOption, tyro.conf.arg(help="take few timings: done in seconds, less accurate")] = False,
) -> int:
    """Time the solver, compared with scipy on a task with known truth: 600 frames, 53 markers, 31 joints."""
    from mocapfix.lab.compared_solvers import measure_in_fresh_process

    with show_progress("solver"):
        results = measure_in_fresh_process(quick)
    return print_results(results, as_json)


def run_bench_uncertainty(
    data: MotionFolderOption = None,
    takes: TakeCountOption = 8,
    known_subject: Annotated[
        FlagOption, tyro.conf.arg(help="calibrate the subject from another take of the same person")
    ] = False,
    as_json: JsonOption = False,
) -> int:  # fmt: skip
    """Compare predicted standard deviations with the true errors of synthetic takes.

    Of a normal distribution, 68 % lie within one standard deviation and 95 % within two.
    """
    from mocapfix.lab.uncertainty import measure_uncertainty

    if takes < 1:
        return print_usage_error(f"bench uncertainty: --takes must be at least 1, not {takes}.")
    with show_progress("uncertainty") as progress:
        results = measure_uncertainty(range(takes), data, is_subject_known=known_subject, report_progress=progress)
    return print_results(results, as_json)


def run_bench_hands(
    people: Annotated[int, tyro.conf.arg(metavar="N", help="number of people")] = 6,
    rigs: Annotated[
        tuple[Path, ...],
        tyro.conf.arg(metavar="FILE", help="characters whose hands the people have; the markers are solved alone"),
    ] = (),
    as_json: JsonOption = False,
) -> int:
    """Solve the fingers of composed people, whose hands are not the model's, from 2 to 20 finger markers and 42 keypoints.

    Errors are mean distances of the tips and mean differences of flexion. Of a normal distribution, 68 % lie within one standard
    deviation and 95 % within two. Labels: exchanges that are undone, ghosts that are found, and right samples that are changed.
    """
    from mocapfix.lab.hands import measure_finger_fills, measure_finger_labels, measure_hands, measure_keypoints, read_rig_hands

    if people < 1:
        return print_usage_error(f"bench hands: --people must be at least 1, not {people}.")
    with show_progress("hands") as progress:
        if hands := {each.stem: read_rig_hands(each) for each in rigs}:
            return print_results({each: measure_hands(range(people), progress, rig) for each, rig in hands.items()}, as_json)
        solved = measure_hands(range(people), progress) | measure_keypoints(range(people), progress)
        results = {"hands": solved, "fills": measure_finger_fills(range(people), progress)}
        results["labels"] = measure_finger_labels(range(people), progress)
    return print_results(results, as_json)


def run_bench_calibration(as_json: JsonOption = False) -> int:
    """Compare calibrated bones, marker offsets and joints with the truth of synthetic people with asymmetric bones."""
    from mocapfix.lab.calibration import measure_calibration

    with show_progress("calibration"):
        rows = measure_calibration()
    return print_results({"people": rows[:-1], "mean": rows[-1]} if as_json else rows, as_json)


def run_bench_session(
    data: MotionFolderOption = None,
    people: Annotated[int, tyro.conf.arg(metavar="N", help="number of people")] = 6,
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="takes of each person")] = 6,
    seconds: Annotated[float, tyro.conf.arg(metavar="S", help="duration of a take")] = 20.0,
    as_json: JsonOption = False,
) -> int:
    """Clean the takes of several people alone and with the person known from all takes, and find markers that moved."""
    from mocapfix.lab.calibration import TEST_PEOPLE, measure_sessions

    if not 1 <= people <= len(TEST_PEOPLE) or takes < 2 or not seconds > 0:
        return print_usage_error(f"bench session: --people is 1 to {len(TEST_PEOPLE)}, --takes at least 2, --seconds above 0.")
    with show_progress("session") as progress:
        errors, outcomes = measure_sessions(data, TEST_PEOPLE[:people], takes, seconds, report_progress=progress)
    print_results({"errors": [asdict(each) for each in errors], "moves": [asdict(each) for each in outcomes]}, as_json)
    if not as_json:
        moved = [each for each in outcomes if each.marker]
        print_line(f"{sum(each.is_found for each in moved)} of {len(moved)} moved markers found.")
        print_line(f"{sum(each.false_alarms for each in outcomes)} false alarms in {len(outcomes)} sessions.")
    return EXIT_DONE


def run_bench_faults(
    data: MotionFolderOption = None,
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="number of takes for each kind of fault")] = 6,
    short: Annotated[FlagOption, tyro.conf.arg(help="inject several kinds into each of a few composed takes")] = False,
    as_json: JsonOption = False,
) -> int:  # fmt: skip
    """Inject faults of every kind into sound takes with known truth, clean them, and score detection and repair.

    The false alarms of "all" are those in the same takes without injected faults.
    """
    from mocapfix.lab.fault_detection import measure_fault_detection, measure_mixed_faults

    with show_progress("faults") as progress:
        rows = measure_mixed_faults(progress) if short else measure_fault_detection(data, takes, progress)
    return print_results(rows, as_json)


def run_bench_labels(data: CapturesOption = None, seed: SeedOption = 0, as_json: JsonOption = False) -> int:
    """Take the labels of takes away, label them again by their marker set, and score the labels.

    tracks: every trajectory a column. ghosts: with points that are no markers. cloud: the points of each frame in random order.
    noise: random occlusions and ghosts in each frame. broken: the same with broken trajectories. two people: clouds of two takes.
    Purity is the share of the points whose tracklet mostly shows the same marker.
    """
    from mocapfix.lab.label_recovery import measure_label_recovery, summarise_label_scores

    with show_progress("labels") as progress:
        scores = measure_label_recovery(data, seed, progress)
    return print_results([asdict(score) for score in scores] if as_json else summarise_label_scores(scores), as_json)


def run_bench_animations(
    data: MotionFolderOption = None,
    trials: Annotated[int, tyro.conf.arg(metavar="N", help="number of trials for each kind of fault")] = 12,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> int:
    """Inject pops, flips, jitter and gaps into sound animations, clean them, and compare with linear interpolation.

    Short faults take 0.2 to 0.5 s, long ones 0.5 to 1 s.
    """
    from mocapfix.lab.animation_repair import measure_animation_repair

    with show_progress("animations") as progress:
        results = measure_animation_repair(data, trials, seed, progress)
    return print_results(results, as_json)


def run_bench_stress(
    data: Annotated[
        FolderLists, tyro.conf.arg(metavar="FOLDER [FOLDER ...]", help="motion with test.npz, whose fastest tenth is used")
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
        results: Mapping[str, Any] = measure_stress(sum(data, ()), motions, rates_hz, progress)
    print_results(results, as_json)
    if not as_json:
        print_line(
            f"Limits: no frame lost in sight, {1e3 * MAX_LIMB_ERROR_M:.0f} mm for a joint of a limb whose markers are all seen, "
            f"{MAX_ERROR_RATIO:g} times the joint error of ordinary motion on average. Frames are counted from 0."
        )
    return EXIT_DONE if results["all"]["within_limits"] else EXIT_FAILED


def run_bench_contacts(
    data: Annotated[
        FolderLists,
        tyro.conf.arg(metavar="FOLDER [FOLDER ...]", help="folders of motion with test.npz, measured by kind of motion"),
    ] = (),
    plates: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="C3D captures with force plates, compared with events from markers")
    ] = None,
    takes: Annotated[
        int, tyro.conf.arg(metavar="N", help="number of takes, with --data of each kind; 0 for force plates alone")
    ] = 6,
    as_json: JsonOption = False,
) -> int:
    """Hold the feet of takes with known truth, whole and with markers of standing feet lost; compare events with force plates."""
    from mocapfix.lab import contacts

    if takes < 0 or (takes == 0 and plates is None):
        return print_usage_error(f"bench contacts: --takes must be at least 1 without --plates, not {takes}.")
    with show_progress("contacts") as progress:
        errors, agreements = contacts.measure_contacts(sum(data, ()), takes, progress) if takes else ([], [])
        events, frames = contacts.measure_plate_events(plates, progress) if plates is not None else ([], [])
    if as_json:
        rows = {"held_feet": errors, "contacts": agreements, "plate_events": events, "plate_frames": frames}
        return print_results({name: [asdict(each) for each in part] for name, part in rows.items()}, as_json)
    return print_results(contacts.summarise_contacts(errors, agreements, events, frames), as_json)


def run_bench_retarget(
    data: MotionFolderOption = None,
    captures: CapturesOption = None,
    characters: Annotated[
        tuple[str, ...], tyro.conf.arg(metavar="NAME|FILE", help="characters; by default all presets")
    ] = CHARACTER_PRESETS,
    feet: Annotated[Literal["soft", "lock", "off"], tyro.conf.arg(help="how standing feet are held")] = "soft",
    as_json: JsonOption = False,
) -> int:
    """Compare presets, other characters and figures of other proportions with the landmarks and markers of the performer."""
    from mocapfix.lab.retargeting import load_bench_motions, measure_characters

    with show_progress("retarget") as progress:
        results = measure_characters(load_bench_motions(data, captures, feet), characters, progress)
    return print_results(results, as_json)


def run_bench_robot(
    robots: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE|FOLDER", help="robots (.xml, .urdf), or folders with .xml")],
    takes: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="TAKE", help="captures of whole bodies")],
    as_json: JsonOption = False,
) -> int:
    """Compare robots with the performer, and measure their feet, limits, collisions and speed; beside mink if it is installed.

    Frames a second are by processor time, of the retargeting alone. Shares are of frames.
    """
    from mocapfix.lab.robots import measure_robots

    with show_progress("robot") as progress:
        rows = measure_robots(robots, takes, progress)
    return print_results(rows, as_json)


def run_bench_conventions(
    takes: TakesArgument,
    cleans: Annotated[int, tyro.conf.arg(metavar="N", help="clean each C3D in N random axes as well")] = 0,
    as_json: JsonOption = False,
) -> int:
    """Read labelled captures in all 48 permutations of their axes and in other units: upright and in scale, or refused.

    The permutations are read with each axis that a file may declare as vertical, and with none. Fails if any is wrong.
    """
    from mocapfix.lab.conventions import WRONG, clean_in_other_axes, measure_conventions

    with show_progress("conventions") as progress:
        rows = [asdict(each) for each in measure_conventions(takes, progress)]
        for row, path in zip(rows, takes, strict=True):
            row["cleans"] = clean_in_other_axes(path, cleans) if cleans and path.suffix.lower() == ".c3d" else {}
    print_results(rows, as_json)
    wrong = sum(outcomes.get(WRONG, 0) for row in rows for outcomes in row.values() if isinstance(outcomes, Mapping))
    if not as_json:
        print_line(f"{len(rows)} captures, {wrong} wrong outcomes.")
    return EXIT_FAILED if wrong else EXIT_DONE


def run_bench_review(
    folder: Annotated[
        Path | None, describe_option("DIR", "keep the takes there, to measure again", "none", name="folder")
    ] = None,
    as_json: JsonOption = False,
) -> int:
    """Measure the review page in Chromium, on a take of ten minutes with thousands of changes.

    Measured are the times until it can be used, of an edit and of a jump, pictures a second, and the server's memory.
    """
    from mocapfix.lab.review_page import measure_review

    with nullcontext(folder) if folder else TemporaryDirectory(prefix="mocapfix-") as used, show_progress("review") as progress:
        figures = measure_review(Path(used), progress)
    return print_results(figures, as_json)


def run_bench_batch(
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="composed takes")] = 20,
    shortest: Annotated[float, tyro.conf.arg(metavar="SECONDS", help="length of the shortest take")] = 10.0,
    longest: Annotated[float, tyro.conf.arg(metavar="SECONDS", help="length of the longest take")] = 20.0,
    workers: WorkersOption = 2,
    as_json: JsonOption = False,
) -> int:
    """Compare a batch with cleaning the same takes in one process: rate, memory of the workers, overhead for each take."""
    from mocapfix.lab.batches import measure_batch_speed

    with TemporaryDirectory(prefix="mocapfix-") as folder, show_progress("batch", needs_kernels=True) as progress:
        result = measure_batch_speed(Path(folder), takes, (shortest, longest), workers, progress)
    print_results(asdict(result) | {"rate_share": result.rate_share}, as_json)
    return EXIT_DONE if result.differing == 0 else EXIT_FAILED


def run_bench_batch_kills(
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="short composed takes")] = 60,
    kills: Annotated[int, tyro.conf.arg(metavar="N", help="how often a worker is killed")] = 5,
    workers: WorkersOption = 2,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> int:
    """Kill workers, the scheduler and the client of a batch at random moments, and compare its outputs with a quiet run."""
    from mocapfix.lab.batches import measure_chaos

    with TemporaryDirectory(prefix="mocapfix-") as folder, show_progress("batch", needs_kernels=True) as progress:
        result = measure_chaos(Path(folder), takes, kills, workers, seed, progress)
    errors = "; ".join(result.client_errors)
    print_results(asdict(result) | {"client_errors": errors, "is_sound": result.is_sound}, as_json)
    return EXIT_DONE if result.is_sound else EXIT_FAILED


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
    from mocapfix.lab import fuzz_c3d, fuzz_characters, fuzz_process, fuzz_readers

    cases = count if count is not None else (QUICK_CASE_COUNTS if quick else CASE_COUNTS)[what]
    if cases < 1:
        return print_usage_error(f"bench fuzz: --count must be at least 1, not {cases}.")
    with show_progress(f"fuzz {what}") as progress:
        if what == "kills":
            with TemporaryDirectory() as folder:
                results = dict(fuzz_process.measure_kills(Path(folder), cases, seed, progress))
            is_sound = not (results["broken_outputs"] or results["changed_inputs"] or results["left_behind"])
        else:
            build_case, limits = {
                "readers": (
                    fuzz_readers.build_folder_builder(files) if files else fuzz_readers.build_reader_case,
                    fuzz_readers.READER_FUZZ_LIMITS,
                ),
                "c3d": (fuzz_c3d.build_c3d_case, fuzz_c3d.C3D_FUZZ_LIMITS),
                "characters": (fuzz_characters.build_character_case, fuzz_readers.READER_FUZZ_LIMITS),
                "cleans": (fuzz_readers.build_clean_case, fuzz_readers.CLEAN_FUZZ_LIMITS),
            }[what]
            results = fuzz_process.run_cases(build_case, range(seed, seed + cases), limits, findings, progress).to_json()
            is_sound = not results["findings"]
    print_results(results, as_json)
    return EXIT_DONE if is_sound else EXIT_FAILED


def run_bench_hybrik(data: UnseenPosesOption = None, captures: CapturesOption = None, as_json: JsonOption = False) -> int:
    """Compare the variants of HybrIK on noisy joints, sources of a bone's twist, initialisations of the solve, and speed."""
    from mocapfix.lab.initialisation import measure_hybrik

    with show_progress("hybrik") as progress:
        results = measure_hybrik(data, captures, progress)
    return print_results(results, as_json)


def run_bench_prior(
    data: UnseenPosesOption = None,
    frames: Annotated[int, tyro.conf.arg(metavar="N", help="number of poses")] = 1000,
    as_json: JsonOption = False,
) -> int:
    """Compare the pose priors: few joints given as in MNN-IK, all joints given, missing limbs, and frames per second."""
    from mocapfix.lab.pose_priors import measure_pose_priors

    with show_progress("prior") as progress:
        results = measure_pose_priors(data, frames, progress)
    return print_results(results, as_json)


def run_bench_learned_ik(
    data: Annotated[Path, tyro.conf.arg(metavar="FOLDER", help="motion with the test subjects in its test.npz")],
    weights: Annotated[
        Path | None, tyro.conf.arg(metavar="FILE.safetensors", help="another network than the shipped one")
    ] = None,
    as_json: JsonOption = False,
) -> int:
    """Measure learned inverse kinematics: one step, whole takes, HybrIK's poses refined, and speed; compared with SMPLify."""
    from mocapfix.lab.learned_ik import measure_learned_ik
    from mocapfix.solve.learned_ik import read_ik_network

    network = read_ik_network(weights) if weights else None
    with show_progress("learned-ik") as progress:
        results = measure_learned_ik(data, progress, network)
    return print_results(results, as_json)


BENCH_COMMANDS = {
    "baseline": run_bench_baseline,
    "batch": run_bench_batch,
    "batch-kills": run_bench_batch_kills,
    "clean": run_bench_clean,
    "solver": run_bench_solver,
    "uncertainty": run_bench_uncertainty,
    "calibration": run_bench_calibration,
    "hands": run_bench_hands,
    "review": run_bench_review,
    "stress": run_bench_stress,
    "faults": run_bench_faults,
    "labels": run_bench_labels,
    "fuzz": run_bench_fuzz,
    "animations": run_bench_animations,
    "hybrik": run_bench_hybrik,
    "prior": run_bench_prior,
    "retarget": run_bench_retarget,
    "robot": run_bench_robot,
    "session": run_bench_session,
    "contacts": run_bench_contacts,
    "conventions": run_bench_conventions,
    "learned-ik": run_bench_learned_ik,
}
