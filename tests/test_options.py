"""Options: defaults, ranges, and changing them by name."""

import re
from dataclasses import replace
from typing import Annotated

import pytest
import tyro

from mocapfix.cli.commands import build_options_argument, parse_options
from mocapfix.errors import OptionError
from mocapfix.model.faults import EXTERNAL_FILL_KINDS, LABEL_KINDS, REPLACED_SAMPLE_KINDS
from mocapfix.option import FRAME_LIMIT
from mocapfix.options import (
    OPTION_BY_NAME,
    OPTIONS,
    PURPOSE_DEFAULTS,
    REPAIRABLE_KINDS,
    CleanOptions,
    FillOptions,
    PriorOptions,
    PurposeOptions,
    ReviewOptions,
    build_clean_options,
    format_arguments,
    parse_arguments,
)


def test_every_option_has_names_of_its_own():
    assert len(OPTION_BY_NAME) == len(OPTIONS)
    flags = [flag for option in OPTIONS for flag in (option.flag, *option.aliases)]
    assert len(set(flags)) == len(flags)
    keys = [option.job_key for option in OPTIONS if option.job_key]
    assert len(set(keys)) == len(keys)


def test_options_are_changed_by_name():
    changed = build_clean_options(prior="none", max_gap_s=2.0)
    assert changed == CleanOptions(prior=PriorOptions(prior="none"), fill=FillOptions(max_gap_s=2.0))
    assert changed.change(prior="autoencoder", max_gap_s=600.0) == CleanOptions()


def test_an_up_axis_is_named_in_either_case():
    assert [build_clean_options(up_axis=axis).read.up_axis for axis in ("y", "-z", "+x")] == ["Y", "-Z", "X"]


def test_one_text_or_a_list_becomes_a_tuple():
    assert build_clean_options(keep="RELB").fill.keep == ("RELB",)
    assert build_clean_options(keep=["RELB", "LKNE"]).fill.keep == ("RELB", "LKNE")


def test_a_text_of_frames_is_read_as_on_the_command_line():
    assert build_clean_options(trim="5:10").output.trim == (5, 10)


def test_values_in_other_units_keep_the_default_exactly():
    for option in OPTIONS:
        default = option.get_value(CleanOptions())
        restored = option.from_display(option.to_display(default))
        assert restored == (pytest.approx(default, rel=1e-12) if isinstance(default, float) else default), option.name


def test_repairable_kinds_are_those_of_faults():
    detected = [kind for kind in REPLACED_SAMPLE_KINDS if kind != "marked"]  # what a reviewer marked is always repaired
    assert ("gap", *detected, *EXTERNAL_FILL_KINDS, *LABEL_KINDS, "fragment") == REPAIRABLE_KINDS


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"max_gap_s": 0.0}, "max_gap_s must be greater than 0 s, not 0."),
        ({"max_sd_m": -0.1}, "max_sd_m must be greater than 0 mm, not -100."),
        ({"max_gap_s": float("nan")}, "max_gap_s must be greater than 0 s, not nan."),
        ({"prior_scale": float("inf")}, "prior_scale must be greater than 0 and finite, not inf."),
        ({"floor_height_m": float("nan")}, "floor_height_m must be finite, not nan."),
        ({"output_rate_hz": 2000.0}, "output_rate_hz must be at least 5 Hz and at most 1000 Hz, not 2000."),
        ({"max_rounds": 0}, "max_rounds must be at least 1, not 0."),
        ({"init_method": "hybrik"}, "init_method must be one of hybrik-x, hybrik-adaptive, "),
        ({"repair_kinds": ("gap", "flaw")}, "repair_kinds must be one of gap, spike, "),
        (
            {"extra_formats": ("avi",)},
            "extra_formats must be one of gltf, amc, npz, amass, c3d, trc, csv, contacts, events, fbx, usd, sheet, robot-npz, "
            "robot-csv, robot-pkl, not 'avi'.",
        ),
        ({"trim": "5"}, "trim must be FIRST:LAST, as in 100:250, not '5'."),
        ({"trim": (5,)}, "trim must be FIRST:LAST, as in 100:250, not (5,)."),
        ({"trim": (900, 100)}, "trim must be FIRST:LAST with FIRST at most LAST, not 900:100."),
        ({"frames": "350:340"}, "frames must be FIRST:LAST with FIRST at most LAST, not 350:340."),
        ({"rest_frame": 2.5}, "rest_frame must be a whole number, not 2.5."),
        ({"up_axis": "W"}, "up_axis must be one of X, -X, Y, -Y, Z, -Z, not 'W'."),
        ({"rate_hz": 1.0}, "rate_hz must be at least 5 Hz and at most 2000 Hz and finite, not 1."),
        ({"max_gap": 1.0}, "max_gap is no option; the options are purpose, unit, "),
    ],
)
def test_wrong_value_is_named(values, message):
    with pytest.raises(OptionError, match=re.escape(message)):
        build_clean_options(**values)


# the purpose


def test_purpose_sets_what_is_not_given():
    lab = build_clean_options(purpose="lab")
    assert (lab.fill.max_sd_m, lab.fill.max_end_sd_m, lab.contacts.feet) == (0.020, 0.0, "off")
    usual = CleanOptions()
    assert (usual.fill.max_sd_m, usual.fill.max_end_sd_m, usual.contacts.feet) == (0.250, 0.060, "soft")
    assert lab.change(purpose="animation") == usual
    assert lab.purpose.given == ("purpose",)


@pytest.mark.parametrize("name", PURPOSE_DEFAULTS)
def test_given_value_wins_over_the_purpose_even_if_it_is_the_usual_default(name):
    usual = PURPOSE_DEFAULTS[name]
    for lab in (
        build_clean_options(**{"purpose": "lab", name: usual}),
        build_clean_options(**{name: usual}).change(purpose="lab"),
        build_clean_options(purpose="lab").change(**{name: usual}).change(max_gap_s=2.0),
    ):
        option = OPTION_BY_NAME[name]
        assert option.get_value(lab) == usual
        assert option.get_value(replace(lab, review=ReviewOptions(("a",)))) == usual
        others = {other for other in PURPOSE_DEFAULTS if other != name}
        assert all(OPTION_BY_NAME[other].get_value(lab) == lab.get_default(other) for other in others)


def test_stages_that_are_built_keep_their_values_with_a_purpose():
    lab = CleanOptions(purpose=PurposeOptions("lab"), fill=FillOptions(max_sd_m=0.030))
    assert (lab.fill.max_sd_m, lab.fill.max_end_sd_m) == (0.030, 0.0)
    assert CleanOptions(fill=FillOptions(max_sd_m=0.020)).change(prior="none").fill.max_sd_m == 0.020


# as arguments


def read_on_the_command_line(arguments: list[str]) -> CleanOptions:
    """Return the options that the command line reads from arguments."""

    def read(options: Annotated[object, build_options_argument()]) -> CleanOptions:
        return parse_options(options)

    return tyro.cli(read, args=arguments)


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"prior": "none", "max_gap_s": 2.5},
        {"repair_kinds": ("gap", "spike"), "keep": ("LFIN", "RFIN")},
        {"keep": ("LFIN", "-RFIN")},
        {"frames": (-5, 250)},
        {"frames": (-FRAME_LIMIT, 250), "trim": (301, FRAME_LIMIT), "loop": True, "root_motion": "bone", "rest_frame": 3},
        {"floor_height_m": -0.125, "up_axis": "Z"},
        {"up_axis": "-y", "unit": "in", "rate_hz": 59.94, "mirror": True, "accept_contradictions": True},
        {"extra_formats": ("gltf", "npz"), "rigs": ("blender",), "output_rate_hz": 30.0},
        {"is_fast": True, "refill": True, "known_sets_only": True},
        {"robust_scales_m": (0.2, 0.07), "min_spike_m": 0.0305, "max_solve_rounds": 2},
        {"marker_set": "cmu41", "subject_prefix": "Jim"},
        {"max_gap_s": float("inf")},
        {"max_sd_m": 1, "max_gap_s": 2, "output_rate_hz": 30, "floor_height_m": 0},
        {"robust_scales_m": (2, 1)},
        {"robust_scales_m": [2, 0.5]},
    ],
)
def test_arguments_are_read_as_the_same_options(values: dict[str, object]) -> None:
    options = build_clean_options(**values)
    arguments = format_arguments(options)
    assert parse_arguments(arguments)[0] == read_on_the_command_line(arguments) == options


def test_arguments_of_other_versions_are_left_out() -> None:
    others = ["--key-reduce=2.0", "--unheard-of", "x"]
    assert parse_arguments([*others, "--refill"]) == (build_clean_options(refill=True), others)
