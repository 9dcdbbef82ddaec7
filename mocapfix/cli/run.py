"""The command that runs a scene: mocapfix run SCENE."""

from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape

from mocapfix.cli.arguments import describe_option
from mocapfix.cli.console import EXIT_DONE, FlagOption, show_progress, stdout_console
from mocapfix.errors import SceneError


def run_scene(
    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE", help="a YAML file, or a shipped scene's name")],
    output_folder: Annotated[
        Path | None, describe_option("DIR", "where outputs go", "SCENE.mocapfix/", name="out", aliases=["-o"])
    ] = None,
    overwrite: Annotated[FlagOption, tyro.conf.arg(help="replace outputs that are there")] = False,
) -> int:
    """Do what a scene says: clean takes as it is written down, or find the motion and camera of a film from 2-D keypoints."""
    from mocapfix.files.shipped import find_shipped_folder, read_yaml

    path = Path(scene) if scene.endswith((".yaml", ".yml")) else find_shipped_folder("scenes") / f"{Path(scene).name}.yaml"
    if path.parent == find_shipped_folder("scenes") and not path.is_file():
        there = ", ".join(sorted(each.stem for each in path.parent.glob("*.yaml")))
        raise SceneError(f"There is no scene named {scene!r}; choose one of: {there}; or give a .yaml file.")
    kind = read_yaml(path).get("kind")
    if not isinstance(kind, str) or kind not in SCENE_RUNNERS:
        raise SceneError(f"{path}: kind: must be one of {', '.join(SCENE_RUNNERS)}, not {kind!r}.")
    return SCENE_RUNNERS[kind](path, output_folder or Path(f"{path.stem}.mocapfix"), overwrite)


def run_cleaning_job(path: Path, output_folder: Path, overwrite: bool) -> int:
    """Takes cleaned as the scene says."""
    from mocapfix import pipeline
    from mocapfix.cli.clean import clean_takes
    from mocapfix.files.output_files import make_output_folder
    from mocapfix.jobs import cleaning_job

    said = cleaning_job.read_cleaning_job(path)
    outputs, takes = said.output_options, said.list_takes(path, output_folder)
    stdout_console.print(f"[bold]{escape(said.title)}[/]: {len(takes)} {'take' if len(takes) == 1 else 'takes'}.", soft_wrap=True)
    make_output_folder(output_folder)
    said.write_composed_takes(output_folder, overwrite)
    given = {
        "marker_set": said.resolve_marker_set(path),
        "subject_prefix": said.subject_prefix,
        "up": said.volume.up,
        "init": said.start,
    }
    given |= {"prior": said.prior.name, "prior_scale": said.prior.scale, "options": said.fill_options, "only": said.fill.only}
    given |= {"hierarchy": said.resolve_hierarchy(path)}
    known = said.find_subject_source(path)
    if isinstance(known, list):
        with show_progress(path.name) as progress:
            progress("calibrate")
            known = pipeline.calibrate(known, given["marker_set"], subject_prefix=said.subject_prefix, up=said.volume.up)
    return clean_takes(takes, output_folder, given | {"subject": known}, outputs, overwrite)


def run_keypoints_job(path: Path, output_folder: Path, overwrite: bool) -> int:
    """Poses and camera from keypoints."""
    from mocapfix.keypoints import keypoint_scene

    with show_progress(path.name) as progress:
        result = keypoint_scene.run_keypoint_scene(path, progress)
        outputs = result.write(output_folder, overwrite)
    record = result.report
    where, camera = record["reprojection_px"], record["camera"]
    stdout_console.print(
        f"[bold]{escape(result.title)}[/]: {record['frames']} frames, keypoints {where['mean']:.1f} px from the body on average; "
        f"the camera sees {camera['pixels_per_metre']:.1f} pixels per metre. {record['seconds']['total']:.1f} s.",
        soft_wrap=True,
    )
    stdout_console.print(
        f"  {escape(str(output_folder))}/: {', '.join(escape(file.name) for file in outputs.values())}", soft_wrap=True
    )
    return EXIT_DONE


SCENE_RUNNERS = {"clean": run_cleaning_job, "keypoints-2d": run_keypoints_job}
