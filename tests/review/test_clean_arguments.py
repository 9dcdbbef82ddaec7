"""The arguments with which a take was cleaned: given to the command line again, they are the same options."""

from pathlib import Path

import pytest

from mocapfix import pipeline
from mocapfix.cli.arguments import build_options_argument, parse_options
from mocapfix.cli.clean import STAGES
from mocapfix.options import CleanOptions, build_clean_options
from mocapfix.review.clean_arguments import build_clean_arguments, find_argument, parse_read_options
from mocapfix.synthetic import compose_take, write_synthetic_take


def parse_arguments(arguments: list[str]) -> CleanOptions:
    """Return the options that the command line reads from arguments."""
    import tyro

    group = build_options_argument(STAGES)

    def read(options: group) -> CleanOptions:  # pyright: ignore[reportInvalidTypeForm]
        return parse_options(options)

    return tyro.cli(read, args=arguments)


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"prior": "none", "max_gap_s": 2.5},
        {"repair_kinds": ("gap", "spike"), "keep": ("LFIN", "RFIN")},
        {"frames": (-5, 250)},
        {"floor_height_m": -0.125, "up_axis": "Z"},
        {"up_axis": "-y", "unit": "in", "rate_hz": 59.94, "mirror": True, "accept_contradictions": True},
        {"extra_formats": ("gltf", "npz"), "rigs": ("blender",), "output_rate_hz": 30.0},
        {"is_fast": True, "refill": True, "known_sets_only": True},
        {"robust_scales_m": (0.2, 0.07), "min_spike_m": 0.0305, "max_solve_rounds": 2},
        {"marker_set": "cmu41", "subject_prefix": "Jim"},
        {"max_gap_s": float("inf")},
    ],
)
def test_arguments_are_read_as_the_same_options(tmp_path: Path, values: dict[str, object]) -> None:
    options = build_clean_options(**values)
    take, *arguments = build_clean_arguments(tmp_path / "take 1.c3d", options, tmp_path / "out", "take 1")
    assert take == "../take 1.c3d"
    assert parse_arguments(arguments) == options
    assert parse_read_options(arguments) == options.read


def test_files_are_named_relative_to_the_outputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("set.yaml", "jim.yaml", "ann.yaml"):
        Path(name).write_text("", encoding="utf-8")
    options = build_clean_options(marker_set="set.yaml", subject=(("Jim", Path("jim.yaml")), ("Ann", Path("ann.yaml"))))
    arguments = build_clean_arguments(Path("walk.c3d"), options, Path("out") / "deep", "walk")
    assert find_argument(arguments, "--marker-set") == "../../set.yaml"
    assert find_argument(arguments, "--subject") == "Jim=../../jim.yaml,Ann=../../ann.yaml"
    options = build_clean_options(subject="jim.yaml", review_files=("set.yaml",))
    assert build_clean_arguments(Path("walk.c3d"), options, Path("out"), "walk") == ["../walk.c3d", "--subject", "../jim.yaml"]


def test_arguments_are_in_the_report(tmp_path: Path) -> None:
    path = tmp_path / "walk.c3d"
    write_synthetic_take(path, compose_take(seconds=1.0, rate=60.0))
    result = pipeline.clean(path, prior="none", max_gap_s=0.5)
    subject = result.subject
    import json

    outputs = result.write(tmp_path / "out")
    report = json.loads(outputs["report.json"].read_text(encoding="utf-8"))
    assert report["arguments"] == ["../walk.c3d", "--prior", "none", "--max-gap=0.5"]
    known = pipeline.clean(path, prior="none", subject=subject).write(tmp_path / "known")
    arguments = json.loads(known["report.json"].read_text(encoding="utf-8"))["arguments"]
    assert find_argument(arguments, "--subject") == known["subject.yaml"].name
