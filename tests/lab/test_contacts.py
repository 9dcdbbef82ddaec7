"""The benchmark of contacts: known slides, drifts and agreements."""

import numpy as np
import pytest

from mocapfix.errors import ReadError
from mocapfix.lab.contacts import (
    GAPS,
    LOST_FEET,
    WHOLE,
    ContactAgreement,
    FootLoss,
    HeldFeetErrors,
    average_errors,
    compute_drift,
    compute_largest_accelerations,
    compute_slide,
    lose_feet,
    measure_soft_mats,
    measure_take,
    read_motion_kinds,
    summarise_contacts,
)
from mocapfix.lab.sound_takes import remove_damage
from mocapfix.synthetic import compose_take

RATE = 100.0


def test_slide_is_the_horizontal_speed_in_contact():
    position = np.zeros((100, 1, 3))
    position[:50, 0, 0] = 0.02 * np.arange(50) / RATE
    position[:, 0, 1] = np.arange(100)
    position[50:, 0, 2] = 5.0 * np.arange(50)
    is_contact = np.zeros((100, 1), bool)
    is_contact[5:45] = True
    assert compute_slide(position, is_contact, RATE) == pytest.approx(20.0)
    assert np.isnan(compute_slide(position, np.zeros((100, 1), bool), RATE))


def test_drift_is_the_mean_over_contacts_of_the_largest_distance():
    position = np.zeros((100, 1, 3))
    position[10:20, 0, 0] = np.linspace(-0.004, 0.004, 10)
    is_contact = np.zeros((100, 1), bool)
    is_contact[10:20] = is_contact[50:60] = True
    assert compute_drift(position, is_contact) == pytest.approx(2.0)


def test_acceleration_is_the_largest_second_difference():
    position = np.zeros((10, 2, 3))
    position[5, 1, 2] = 0.1
    np.testing.assert_allclose(compute_largest_accelerations(position), [0, 0.2])


def test_f1_counts_frames():
    assert ContactAgreement("take", WHOLE, 100, 50, 50).f1 == pytest.approx(2 / 3)
    assert ContactAgreement("take", WHOLE, 0, 0, 0).f1 == 0


def test_ratios_are_those_of_the_worst_take_and_errors_are_means():
    errors = [
        HeldFeetErrors(f"take {k}", WHOLE, "lock", 1.0, 1.0, float(k), 1.0, 1.0, 1.0 + k, 1.0, 0.0, np.nan) for k in range(3)
    ]
    means = average_errors(errors)
    assert means["drift_mm"] == pytest.approx(1.0)
    assert means["acceleration_ratio"] == pytest.approx(3.0)
    assert np.isnan(means["lost_fill_mm"])


def test_holding_feet_of_a_composed_take():
    sound = remove_damage(compose_take(seed=1, seconds=6.0))
    errors, agreements = measure_take("seed 1", {WHOLE: sound, LOST_FEET: lose_feet(sound, [FootLoss("left", 560, 640)])})
    by_mode = {(each.damage, each.mode): each for each in errors}
    assert set(by_mode) == {(damage, mode) for damage in (WHOLE, LOST_FEET) for mode in ("off", "soft", "lock")}
    for damage in (WHOLE, LOST_FEET):
        off, soft, lock = (by_mode[damage, mode] for mode in ("off", "soft", "lock"))
        assert lock.drift_mm < 1.0 < off.drift_mm
        assert lock.slide_mm_s < soft.slide_mm_s < off.slide_mm_s
        for held in (soft, lock):
            assert held.other_joints_mm < off.other_joints_mm + 1.0
            assert held.acceleration_ratio < 1.2
            assert held.sink_mm < 0.2
    assert by_mode[LOST_FEET, "soft"].lost_fill_mm < by_mode[LOST_FEET, "off"].lost_fill_mm
    assert min(each.f1 for each in agreements) > 0.95


def test_a_mat_that_hardly_yields_hides_few_contacts_and_a_deep_one_more():
    by_depth = [each.f1 for each in measure_soft_mats("seed 1", remove_damage(compose_take(seed=1, seconds=6.0)))]
    assert by_depth == sorted(by_depth, reverse=True)
    assert by_depth[0] > 0.95 > by_depth[-1] > 0.8


def test_kinds_are_those_of_descriptions(tmp_path):
    texts = {"1": "walk forward", "2": "run / jog", "3": "walk backwards", "4": "cartwheel", "5": "boxing", "6": "drink soda"}
    rows = "".join(f'{trial},"{text}"\n' for trial, text in texts.items())
    (tmp_path / "manifest.csv").write_text(f"trial,description\n{rows}", encoding="utf-8")
    kinds = read_motion_kinds(tmp_path / "manifest.csv")
    assert list(kinds.values()) == ["walk", "run", "backwards", "acrobatics", "martial arts", "stand"]
    with pytest.raises(ReadError, match=r"none\.csv: is not a table of trials"):
        read_motion_kinds(tmp_path / "none.csv")


def test_the_table_by_kind_pools_frames_and_names_the_worst_take():
    good, bad = (ContactAgreement(name, GAPS, 100, 100, common, "walk") for name, common in (("a", 100), ("b", 40)))
    errors = [
        HeldFeetErrors(name, GAPS, mode, slide, 3.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, np.nan)
        for name, slide in (("a", 10.0), ("b", 20.0), ("c", 90.0))
        for mode in ("lock", "off")
    ]
    table = summarise_contacts(errors, [good, bad, ContactAgreement("c", GAPS, 1, 0, 0, "run")], [], [])["gaps, feet locked"]
    assert table["walk"] == {
        "takes": 2, "f1": 0.7, "worst_f1": 0.4, "worst_take": "b", "slide_mm_s": 15.0, "true_slide_mm_s": 3.0, "drift_mm": 1.0
    }  # fmt: skip
    assert list(table) == ["run", "walk"]
