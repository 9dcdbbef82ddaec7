"""The commands that repeat the experiments of papers: `mocapfix bench hybrik` (HybrIK), `bench prior` and `bench hands` (MNN-IK).

They measure HybrIK's closed form, the initialisations of the solve, and the pose priors.

The command `mocapfix bench contacts`: contacts, held feet and gait events, compared with known truth and force plates.

The command `mocapfix bench learned-ik`.

The command `mocapfix bench retarget`: motion on characters, and back.

The command `mocapfix bench review`: the review page in a browser.

The command `mocapfix bench session`: takes cleaned alone, and with the person known from all takes of the session.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from math import isnan
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.markup import escape
from rich.table import Table

from mocapfix.cli.arguments import JsonOption, describe_option
from mocapfix.cli.console import EXIT_DONE, print_json, print_line, print_usage_error, show_progress, stdout_console

if TYPE_CHECKING:
    from mocapfix.lab.contacts import ContactAgreement, HeldFeetErrors, PlateAgreement, PlateEventError


JITTER_FIGURE_NAME = "hybrik-jitter.png"
TWIST_FIGURE_NAME = "twist-distribution.png"


def run_bench_hybrik(
    data: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FOLDER", help="CMU motion with the test subjects; by default 1,000 shipped poses of theirs"),
    ] = None,
    captures: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="C3D files on which the initialisations are compared too")
    ] = None,
    figures: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="DIR",
            help=f"draw the errors into {JITTER_FIGURE_NAME} and, with --data, people's twists into {TWIST_FIGURE_NAME}",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> int:
    """Compare the variants of HybrIK on noisy joints, sources of a bone's twist, initialisations of the solve, and speed."""
    from mocapfix.io.files import make_output_folder
    from mocapfix.lab.initialisation import measure_hybrik

    if figures:
        make_output_folder(figures)
    with show_progress("hybrik") as progress:
        results: Mapping[str, Any] = measure_hybrik(data, captures, progress)
    if figures:
        draw_hybrik_figures(figures, data, results)
    if as_json:
        print_json(results)
        return EXIT_DONE
    stdout_console.print(f"{results['poses']:,} poses of people outside the training data; mm over all joints/body/hands")
    stdout_console.print(build_jitter_table("distance from the true joints", results["jitter_mm"], results["given_mm"]))
    stdout_console.print(build_jitter_table("distance from the given joints", results["from_given_mm"]))
    stdout_console.print(
        build_jitter_table("distance from the true joints, with another person's bones", results["wrong_bones_mm"])
    )
    stdout_console.print(build_twist_table(results["twist"]))
    closed_form_fps = ", ".join(f"{variant} {fps:,.0f}" for variant, fps in results["fps_by_way"].items())
    stdout_console.print(
        f"Frames per second on {results['threads']} threads: X {results['fps']:,.0f} from joints, "
        f"{results['from_markers_fps']:,.0f} from markers. Closed form alone, with given twists: {closed_form_fps}."
    )
    for name, rows in results["starts"].items():
        stdout_console.print(build_initialisation_table(name, rows))
    return EXIT_DONE


def draw_hybrik_figures(folder: Path, data: Path | None, results: Mapping[str, Any]) -> None:
    """Draw the errors on noisy joints and, if there is motion, the distribution of twists, into a folder."""
    from mocapfix.lab import hands, hybrik_tables

    hands.draw_joint_noise(folder / JITTER_FIGURE_NAME, dict(results))
    if data:
        hands.draw_twists(folder / TWIST_FIGURE_NAME, hybrik_tables.compute_twist_distribution(data))


def build_jitter_table(title: str, results: Mapping[str, Any], unprocessed: Mapping[str, Any] | None = None) -> Table:
    """Return the errors of each variant by the noise of the joints.

    results      errors by part of the body, by variant, by noise in mm
    unprocessed  errors of the noisy joints themselves, by noise, for the first row
    """
    table = Table("", *(f"±{noise_mm} mm" for noise_mm in results), title=title, title_justify="left")
    rows: dict[str, Mapping[str, Any]] = {"as given": unprocessed} if unprocessed else {}
    rows |= {variant: {noise: by_variant[variant] for noise, by_variant in results.items()} for variant in results["0"]}
    for variant, row in rows.items():
        table.add_row(variant, *("/".join(f"{error:.1f}" for error in errors.values()) for errors in row.values()))
    return table


def build_twist_table(results: Mapping[str, Any]) -> Table:
    """Return the errors of joints, markers and twists by source of the twists."""
    table = Table("twists", *results)
    for key, heading in (("joints_mm", "joints, mm"), ("markers_mm", "markers, mm")):
        table.add_row(f"[bold]{heading}[/]", *(f"{row[key]:.1f}" for row in results.values()))
    table.add_section()
    for joint_name in next(iter(results.values()))["twist_deg"]:
        table.add_row(f"{joint_name}, degrees", *(f"{row['twist_deg'][joint_name]:.1f}" for row in results.values()))
    return table


def build_initialisation_table(takes: str, results: Mapping[str, Any]) -> Table:
    """Return the outcome of the solves of some takes by initialisation."""
    title = f"{takes}: {next(iter(results.values()))['frames']:,} frames"
    table = Table("", *results, title=title, title_justify="left")
    for key, heading, number_format in (
        ("start_markers_mm", "marker distance before the solve, mm", ".1f"),
        ("start_joints_mm", "joint error before the solve, mm", ".1f"),
        ("wrong_first_solve", "wrong frames, first solve", "d"),
        ("wrong", "wrong frames", "d"),
        ("wrong_from_start", "... but not when initialised with the truth", "d"),
        ("unconverged", "unconverged frames", "d"),
        ("iterations_first_solve", "iterations, first solve", ".1f"),
        ("iterations", "iterations", ".1f"),
        ("start_seconds", "initialisation, s", ".2f"),
        ("seconds", "initialisation and solve, s", ".2f"),
    ):
        table.add_row(heading, *("" if row[key] is None else format(row[key], number_format) for row in results.values()))
    return table


def run_bench_prior(
    data: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FOLDER", help="motion with the test subjects; by default 1,000 shipped poses of theirs"),
    ] = None,
    frames: Annotated[int, tyro.conf.arg(metavar="N", help="number of poses")] = 1000,
    paper_split: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="FOLDER", help="weights trained with --interleaved: repeat MNN-IK's test on its own split; needs --data"
        ),
    ] = None,
    figure: Annotated[Path | None, tyro.conf.arg(metavar="FILE.png", help="draw the errors over the iterations")] = None,
    as_json: JsonOption = False,
) -> int:
    """Compare the pose priors: few joints given as in MNN-IK, all joints given, missing limbs, and frames per second."""
    from mocapfix.io.files import make_output_folder
    from mocapfix.lab import hands
    from mocapfix.lab.pose_priors import measure_pose_priors

    if figure:
        make_output_folder(figure.parent)
    with show_progress("prior") as progress:
        results: dict[str, Any] = measure_pose_priors(data, frames, paper_split, figure is not None, progress)
    default = results["default"]
    if figure:
        hands.draw_iterations(figure, results["iterations"], default)
    if as_json:
        print_json(results)
        return EXIT_DONE
    title = f"{results['poses']} poses of people outside the training data"
    stdout_console.print(build_given_joints_table(title, results, default))
    if "paper_split" in results:
        title = "split of the MNN-IK paper: frames between those of the training data"
        stdout_console.print(build_given_joints_table(title, results["paper_split"], default))
    table = Table("all joints given", "bias, mm", "error with noise of 3 mm, mm", "twist, degrees")
    for name, row in results["all_joints"].items():
        table.add_row(name, f"{row['bias_mm']:.2f}", f"{row['noisy_mm']:.2f}", f"{row['twist_deg']:.1f}")
    stdout_console.print(table)
    if results["limb"]:
        stdout_console.print(build_limb_table(results["limb"]))
    stdout_console.print(
        f"{default}: {results['fps']:,.0f} frames per second with 10 given joints, initialised with a smoothed motion; "
        f"{results['fps_from_mean_pose']:,.0f} initialised with the mean pose."
    )
    return EXIT_DONE


def build_limb_table(results: Mapping[str, Any]) -> Table:
    """Return the errors of a missing limb's joints, of mocapfix and of each method alone."""
    gaps = [(limb, duration_s) for limb in ("arm", "leg") for duration_s in results[limb]]
    table = Table("joints of a missing limb, mm", *(f"{limb}, {duration_s} s" for limb, duration_s in gaps))
    for method, row in (("[bold]mocapfix[/]", results), *results["ways"].items()):
        table.add_row(method, *(f"{row[limb][duration_s]:.0f}" for limb, duration_s in gaps))
    return table


def build_given_joints_table(title: str, results: Mapping[str, Any], default: str) -> Table:
    """Return MNN-IK's table: the errors of each prior by the number of given joints.

    default  the name of the prior that the caption compares with the others
    """
    by_count = results["given_joints"]
    table = Table("mm / degrees", *(f"{count} joints" for count in by_count), title=title, title_justify="left")
    for name in next(iter(by_count.values())):
        cells = [
            f"{row['position_mm']:.1f} ± {row['position_sd']:.0f} / {row['rotation_deg']:.1f} ± {row['rotation_sd']:.0f}"
            for row in (by_name[name] for by_name in by_count.values())
        ]
        table.add_row(name, *cells)
    improvements = [
        f"{row['position_percent']:.0f} and {row['rotation_percent']:.0f} % better than {name}"
        for name, row in results["better"].items()
    ]
    table.caption = f"{default} is {', '.join(improvements)} (mean of the columns)"
    return table


def run_bench_hands(
    one_marker: Annotated[
        Path, tyro.conf.arg(metavar="TAKE", help="a C3D with CMU's 41 markers, of which one is kept on the right hand")
    ],
    crossed: Annotated[Path, tyro.conf.arg(metavar="TAKE", help="a take in which the hands meet; noise is added")],
    output_folder: Annotated[
        Path, tyro.conf.arg(name="out", aliases=["-o"], metavar="DIR", help="folder for the two pictures")
    ] = Path(),
    as_json: JsonOption = False,
) -> int:
    """Damage the hands in two sound captures as in section 5.1 of MNN-IK, clean them, and draw both."""
    from mocapfix.io.files import make_output_folder
    from mocapfix.lab import hands

    make_output_folder(output_folder)
    results: dict[str, dict[str, float]] = {}
    for name, path, damage in (
        ("hand-one-marker", one_marker, hands.ONE_MARKER_DAMAGE),
        ("crossed-hands", crossed, hands.CROSSED_HANDS_DAMAGE),
    ):
        with show_progress(path.name):
            comparison = hands.compare_hands(path, damage)
        picture = output_folder / f"{name}.png"
        hands.draw_hands(picture, comparison)
        results[name] = {"alone_mm": comparison.markers_only_mm, "cleaned_mm": comparison.cleaned_mm}
        if not as_json:
            errors = f"error {comparison.markers_only_mm:.0f} mm from the markers alone, {comparison.cleaned_mm:.0f} mm cleaned"
            print_line(f"{escape(str(picture))}: {errors}.")
    if as_json:
        print_json(results)
    return EXIT_DONE


HELD_COLUMNS = (
    ("slide_mm_s", "slide, mm/s", ".1f"),
    ("true_slide_mm_s", "true slide", ".1f"),
    ("drift_mm", "drift, mm", ".2f"),
    ("feet_mm", "feet, mm", ".1f"),
    ("other_joints_mm", "other joints, mm", ".1f"),
    ("acceleration_ratio", "acceleration ratio", ".2f"),
    ("knee_ratio", "of knees", ".2f"),
    ("sink_mm", "sink, mm", ".2f"),
    ("lost_fill_mm", "lost markers, mm", ".1f"),
)
"""Key, heading and number format of a column."""


def run_bench_contacts(
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="motion with the test subjects; by default composed motion")
    ] = None,
    plates: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="C3D captures with force plates, compared with events from markers")
    ] = None,
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="number of takes; 0 for force plates alone")] = 6,
    as_json: JsonOption = False,
) -> int:
    """Hold the feet of takes with known truth, whole and with markers of standing feet lost; compare events with force plates."""
    from mocapfix.lab.contacts import measure_contacts, measure_plate_events

    if takes < 0 or (takes == 0 and plates is None):
        return print_usage_error(f"bench contacts: --takes must be at least 1 without --plates, not {takes}.")
    with show_progress("contacts") as progress:
        errors, agreements = measure_contacts(data, takes, progress) if takes else ([], [])
        events, frames = measure_plate_events(plates, progress) if plates is not None else ([], [])
    if as_json:
        print_json(
            {name: [asdict(each) for each in rows] for name, rows in _name_rows(errors, agreements, events, frames).items()}
        )
        return EXIT_DONE
    if errors:
        stdout_console.print(build_held_table(errors))
        _print_agreement(agreements)
    if plates is not None:
        _print_plate_errors(events, frames)
    return EXIT_DONE


def build_held_table(errors: "Sequence[HeldFeetErrors]") -> Table:
    """Return the mean over takes of each damage and way to hold feet."""
    from mocapfix.lab.contacts import average_errors

    table = Table("damage", "feet", *(heading for _, heading, _ in HELD_COLUMNS))
    groups: dict[tuple[str, str], list[HeldFeetErrors]] = defaultdict(list)
    for each in errors:
        groups[each.damage, each.mode].append(each)
    for (damage, mode), rows in groups.items():
        values = [(average_errors(rows, key), number_format) for key, _, number_format in HELD_COLUMNS]
        table.add_row(damage, mode, *("" if isnan(value) else format(value, number_format) for value, number_format in values))
    return table


def _print_agreement(agreements: "Sequence[ContactAgreement]") -> None:
    for damage in dict.fromkeys(each.damage for each in agreements):
        own = [each for each in agreements if each.damage == damage]
        common, found, true = (sum(getattr(each, f"{name}_frames") for each in own) for name in ("common", "found", "true"))
        mean_f1 = sum(each.f1 for each in own) / len(own)
        print_line(
            f"Contacts, {damage}: precision {common / max(found, 1):.3f}, recall {common / max(true, 1):.3f}, "
            f"F1 {2 * common / max(found + true, 1):.3f}; mean F1 of the takes {mean_f1:.3f}."
        )


def _print_plate_errors(events: "Sequence[PlateEventError]", frames: "Sequence[PlateAgreement]") -> None:
    import numpy as np

    from mocapfix.lab.contacts import compute_frame_f1

    for kind in ("foot strike", "foot off"):
        errors = np.array([each.error_ms for each in events if each.kind == kind])
        found = errors[np.isfinite(errors)]
        if len(found):
            print_line(
                f"{kind}: {len(found)} of {len(errors)} found, median error {np.median(np.abs(found)):.1f} ms, "
                f"median delay {np.median(found):.1f} ms."
            )
    if not events:
        print_line("No capture has a load of a force plate by a single foot.")
        return
    events_f1, rule_f1 = (compute_frame_f1(frames, method) for method in ("events", "height and speed"))
    print_line(f"F1 by frame: {events_f1:.3f}; of the height-and-speed rule {rule_f1:.3f}.")


def _name_rows(*rows: Sequence[Any]) -> dict[str, Sequence[Any]]:
    return dict(zip(("held_feet", "contacts", "plate_events", "plate_frames"), rows, strict=True))


PLUG_IN_COLUMNS = {
    "hybrik_x": "HybrIK-X",
    "hybrik_x_prior": "solved with the prior",
    "pass_1": "1 pass",
    "pass_2": "2 passes",
    "pass_3": "3 passes",
    "smoothed_hybrik_x": "smoothed joints: HybrIK-X",
    "smoothed_hybrik_x_prior": "solved with the prior",
    "window": "3 passes",
}


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
        results: Mapping[str, Any] = measure_learned_ik(data, progress, network)
    if as_json:
        print_json(results)
        return EXIT_DONE
    stdout_console.print(build_one_step_table(results))
    stdout_console.print(
        f"Whole takes from a true first frame: {results['sequential_mm']:.2f} mm, "
        f"{results['sequential_selected_mm']:.2f} mm with the published selector (median over takes); "
        f"worst take {results['sequential_worst_take_mm']:.2f} mm."
    )
    stdout_console.print(build_plug_in_table(results["plug_in_mm"]))
    stdout_console.print(
        f"Frames per second on one core: {results['fps_single']:,.0f} single, {results['fps_batch']:,.0f} in batches; "
        f"{results['over_smplify']:,.0f} times as fast as SMPLify."
    )
    return EXIT_DONE


def build_one_step_table(results: Mapping[str, Any]) -> Table:
    """Return the errors of one step by the number of frames from the start."""
    title = f"one step, {results['frames']:,} frames of people outside the training data; mm"
    table = Table("frames from the start", *results["one_step_mm"], title=title, title_justify="left")
    rows = {"the start itself": results["copied_mm"], "SMPLify, 100 iterations": results["smplify_mm"]}
    for passes, row in results["one_step_passes_mm"].items():
        rows[f"learned, {passes} pass{'es' if passes != '1' else ''}"] = row
    for name, row in rows.items():
        table.add_row(name, *(f"{value:.2f}" for value in row.values()))
    return table


def build_plug_in_table(results: Mapping[str, Mapping[str, float]]) -> Table:
    """Return the errors of HybrIK's poses and of what follows them."""
    table = Table("joints with noise of 20 mm; mm", *PLUG_IN_COLUMNS.values())
    for key, name in (("noise", "all given"), ("arm_missing", "an arm missing")):
        table.add_row(name, *(f"{results[key][column]:.1f}" for column in PLUG_IN_COLUMNS))
    return table


def run_bench_retarget(
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="motion with the test subjects; by default composed motion")
    ] = None,
    as_json: JsonOption = False,
) -> int:
    """Retarget motion onto each preset and back, and onto characters of other proportions, beside copied rotations."""
    from mocapfix.lab.retargeting import load_bench_motions, measure_proportions, measure_round_trips

    with show_progress("retarget") as progress:
        motions = load_bench_motions(data)
        trips = measure_round_trips(motions, progress)
        proportions = measure_proportions(motions, progress)
    if as_json:
        print_json({"presets": [asdict(each) for each in trips], "proportions": [asdict(each) for each in proportions]})
        return EXIT_DONE
    table = Table("preset", "joints, mm", "99 %", "rotations, deg", "99 %", "copied: joints, mm", "deg", "frames per second")
    for trip in trips:
        figures = (trip.joints_mm, trip.joints_p99_mm, trip.rotations_deg, trip.rotations_p99_deg, trip.copied_joints_mm)
        copied_deg, speed = f"{trip.copied_rotations_deg:.2f}", f"{trip.frames_per_second:,.0f}"
        table.add_row(trip.character, *(f"{figure:.2f}" for figure in figures), copied_deg, speed)
    stdout_console.print(table)
    table = Table("character", "method", "skate ratio", "slide, mm/s", "hands at most, mm", "palms in thighs", "depth, mm")
    for each in proportions:
        figures = (f"{each.skate_ratio:.4f}", f"{each.slide_mm_s:.1f}", f"{each.hands_mm:.1f}")
        table.add_row(each.character, each.method, *figures, f"{each.penetration_share:.4f}", f"{each.penetration_mm:.3f}")
    stdout_console.print(table)
    return EXIT_DONE


def run_bench_review(
    folder: Annotated[
        Path | None, describe_option("DIR", "keep the takes there, to measure again", "none", name="folder")
    ] = None,
    as_json: JsonOption = False,
) -> int:
    """Measure the review page in Chromium, on a take of a minute and one of ten minutes.

    Measured are the time until it can be used, the time of an edit, pictures a second while playing, and the server's memory.
    """
    from mocapfix.lab.review_page import measure_review

    with nullcontext(folder) if folder else TemporaryDirectory(prefix="mocapfix-") as used, show_progress("review") as progress:
        figures = measure_review(Path(used), progress)
    if as_json:
        print_json(figures)
        return EXIT_DONE
    table = Table("quantity", "measured")
    table.add_row("page can be used after", f"{figures['ready_s']:.2f} s")
    table.add_row("a decision is saved after", f"{figures['saved_ms']:.0f} ms")
    table.add_row("the page shows it after", f"{figures['shown_ms']:.0f} ms")
    table.add_row("pictures a second while playing", f"{figures['frames_per_s']:.0f}")
    table.add_row("memory of the server, ten minutes of take", f"{figures['server_memory_mb']:.0f} MB")
    stdout_console.print(table)
    return EXIT_DONE


def run_bench_session(
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="motion with the test subjects; by default composed motion")
    ] = None,
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
    if as_json:
        print_json({"errors": [asdict(each) for each in errors], "moves": [asdict(each) for each in outcomes]})
        return EXIT_DONE
    table = Table("person", "method", "joints, mm", "bones, mm", "places, mm", "CPU s")
    for each in errors:
        figures = (each.joints_mm, each.bones_mm, each.places_mm, each.cpu_s)
        table.add_row(each.person, each.method, *(f"{figure:.2f}" for figure in figures))
    stdout_console.print(table)
    moved = [each for each in outcomes if each.marker]
    print_line(f"{sum(each.is_found for each in moved)} of {len(moved)} moved markers found.")
    print_line(f"{sum(each.false_alarms for each in outcomes)} false alarms in {len(outcomes)} sessions.")
    return EXIT_DONE
