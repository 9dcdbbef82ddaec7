"""The options of output files; they are part of `mocapfix.options`."""

from dataclasses import dataclass
from pathlib import Path

from mocapfix.files import option_choices as choices
from mocapfix.files.option_definitions import StageOptions, define_option


@dataclass(frozen=True)
class OutputOptions(StageOptions):
    """Output files."""

    extra_formats: tuple[str, ...] = define_option(
        (), "--also", "FORMAT,...", f"also write these formats: {', '.join(choices.EXTRA_FORMAT_NAMES)}",
        job_key="write.also", default_text="none", choices=choices.EXTRA_FORMAT_NAMES,
    )  # fmt: skip
    rigs: tuple[str, ...] = define_option(
        (), "--bvh-for", "PROGRAM,...", f"also write a BVH for each program: {', '.join(choices.RIG_NAMES)}, or a rig's .yaml",
        job_key="write.bvh_for", default_text="none",
    )  # fmt: skip
    output_rate_hz: float | None = define_option(
        None, "--fps", "N", "frame rate of the BVH and the other motion files", job_key="write.fps", unit="Hz",
        default_text="that of the take", at_least=5.0, at_most=1000.0,
    )  # fmt: skip
    floor_height_m: float = define_option(
        0.0, "--floor", "METRES", "height of the floor in the file; motion files have their floor at 0",
        job_key="volume.floor", unit="m", is_finite=True,
    )  # fmt: skip
    characters: tuple[str | Path, ...] = define_option(
        (), "--character", "PRESET|FILE",
        f"also write the motion of a character: {', '.join(choices.CHARACTER_PRESETS)}, or a .glb, .vrm, .bvh or .yaml file",
        job_key="write.character", default_text="none",
    )  # fmt: skip
    character_map: str | Path | None = define_option(
        None, "--character-map", "FILE", "YAML file with the bones of the character's body, as written beside its motion",
        job_key="write.character_map", default_text="by the names of the bones, or the shape of the skeleton",
    )  # fmt: skip
    key_error_deg: float | None = define_option(
        None, "--key-reduce", "DEGREES", "write fewer keys into .glb and .fbx: no rotation differs by more than this",
        job_key="write.key_reduce", unit="degrees", default_text="a key in every frame", above=0.0, at_most=90.0,
    )  # fmt: skip
