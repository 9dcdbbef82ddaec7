"""The command `mocapfix run`: run a scene, which is a cleaning job or a 2-D keypoint scene."""

from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape

from mocapfix.cli.arguments import OverwriteOption, describe_option
from mocapfix.cli.clean import clean_takes, print_output_files
from mocapfix.cli.console import EXIT_DONE, print_line, show_progress
from mocapfix.errors import SceneError


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
    from mocapfix.files.shipped import find_shipped_folder, read_yaml

    shipped_folder = find_shipped_folder("scenes")
    path = Path(scene) if scene.endswith((".yaml", ".yml")) else shipped_folder / f"{Path(scene).name}.yaml"
    if path.parent == shipped_folder and not path.is_file():
        names = ", ".join(sorted(each.stem for each in shipped_folder.glob("*.yaml")))
        raise SceneError(f"There is no scene named {scene!r}; choose one of: {names}; or name a .yaml file.")
    kind = read_yaml(path).get("kind")
    if not isinstance(kind, str) or kind not in SCENE_RUNNERS:
        raise SceneError(f"{path}: kind: must be one of {', '.join(SCENE_RUNNERS)}, not {kind!r}.")
    return SCENE_RUNNERS[kind](path, output_folder or Path(f"{path.stem}.mocapfix"), overwrite)


def run_cleaning_job(path: Path, output_folder: Path, overwrite: bool) -> int:
    """Clean the takes of the job at `path`; return the exit status."""
    from mocapfix import pipeline
    from mocapfix.files.output_files import make_output_folder
    from mocapfix.jobs.cleaning_job import read_cleaning_job

    job = read_cleaning_job(path)
    takes = job.list_takes(output_folder)
    print_line(f"[bold]{escape(job.header.title)}[/]: {len(takes)} {'take' if len(takes) == 1 else 'takes'}.")
    make_output_folder(output_folder)
    job.write_composed_takes(output_folder, overwrite)
    subject = job.get_subject_file()
    if calibration_takes := job.list_calibration_takes():
        with show_progress(path.name, needs_kernels=True) as progress:
            progress("calibrate")
            subject = pipeline.calibrate_takes(calibration_takes, job.options)
    return clean_takes(takes, output_folder, job.options.change(subject=subject), overwrite=overwrite)


def run_keypoints_job(path: Path, output_folder: Path, overwrite: bool) -> int:
    """Estimate poses and camera of the keypoint scene at `path`; return the exit status."""
    from mocapfix.keypoints import keypoint_scene

    with show_progress(path.name) as progress:
        result = keypoint_scene.run_keypoint_scene(path, progress)
        outputs = result.write(output_folder, overwrite)
    report = result.report
    print_line(
        f"[bold]{escape(result.title)}[/]: {report['frames']} frames, mean reprojection error "
        f"{report['reprojection_px']['mean']:.1f} px; camera scale {report['camera']['pixels_per_metre']:.1f} pixels per metre. "
        f"{report['seconds']['total']:.1f} s."
    )
    print_output_files(outputs)
    return EXIT_DONE


SCENE_RUNNERS = {"clean": run_cleaning_job, "keypoints-2d": run_keypoints_job}
