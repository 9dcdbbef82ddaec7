"""The command that runs a scene: mocapfix run SCENE."""

from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape

from mocapfix.cli_arguments import shown
from mocapfix.console import DONE, Flag, out, staged
from mocapfix.errors import SceneError


def run(
    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE", help="a YAML file, or a shipped scene's name")],
    folder: Annotated[
        Path | None, shown("DIR", "where outputs go", "SCENE.mocapfix/", name="out", aliases=["-o"])
    ] = None,
    overwrite: Annotated[Flag, tyro.conf.arg(help="replace outputs that are there")] = False,
) -> int:
    """Do what a scene says: clean takes as it is written down, or find the motion and camera of a film from 2-D keypoints."""
    from mocapfix.scenes import folder as shipped
    from mocapfix.scenes import read_yaml

    path = Path(scene) if scene.endswith((".yaml", ".yml")) else shipped("scenes") / f"{Path(scene).name}.yaml"
    if path.parent == shipped("scenes") and not path.is_file():
        there = ", ".join(sorted(each.stem for each in path.parent.glob("*.yaml")))
        raise SceneError(f"There is no scene named {scene!r}; choose one of: {there}; or give a .yaml file.")
    kind = read_yaml(path).get("kind")
    if not isinstance(kind, str) or kind not in SCENES:
        raise SceneError(f"{path}: kind: must be one of {', '.join(SCENES)}, not {kind!r}.")
    return SCENES[kind](path, folder or Path(f"{path.stem}.mocapfix"), overwrite)


def clean(path: Path, folder: Path, overwrite: bool) -> int:
    """Takes cleaned as the scene says."""
    from mocapfix import job, pipeline
    from mocapfix.cli_clean import cleaned
    from mocapfix.files import make_folder

    said = job.load(path)
    outputs, takes = said.outputs, said.found(path, folder)
    out.print(f"[bold]{escape(said.title)}[/]: {len(takes)} {'take' if len(takes) == 1 else 'takes'}.", soft_wrap=True)
    make_folder(folder)
    said.compose(folder, overwrite)
    given = {"marker_set": said.worn(path), "subject_prefix": said.subject_prefix, "up": said.volume.up, "init": said.start}
    given |= {"prior": said.prior.name, "prior_scale": said.prior.scale, "options": said.options, "only": said.fill.only}
    given |= {"hierarchy": said.named(path)}
    known = said.known(path)
    if isinstance(known, list):
        with staged(path.name) as progress:
            progress("calibrate")
            known = pipeline.calibrated(known, given["marker_set"], subject_prefix=said.subject_prefix, up=said.volume.up)
    return cleaned(takes, folder, given | {"subject": known}, outputs, overwrite)


def keypoints_2d(path: Path, folder: Path, overwrite: bool) -> int:
    """Poses and camera from keypoints."""
    from mocapfix.keypoints import scene

    with staged(path.name) as progress:
        result = scene.run(path, progress)
        outputs = result.write(folder, overwrite)
    record = result.report
    where, camera = record["reprojection_px"], record["camera"]
    out.print(
        f"[bold]{escape(result.title)}[/]: {record['frames']} frames, keypoints {where['mean']:.1f} px from the body on average; "
        f"the camera sees {camera['pixels_per_metre']:.1f} pixels per metre. {record['seconds']['total']:.1f} s.",
        soft_wrap=True,
    )
    out.print(f"  {escape(str(folder))}/: {', '.join(escape(file.name) for file in outputs.values())}", soft_wrap=True)
    return DONE


SCENES = {"clean": clean, "keypoints-2d": keypoints_2d}
