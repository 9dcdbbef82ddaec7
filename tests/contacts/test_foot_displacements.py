"""Where standing feet shall be: at one place, without fast motion, and smoothly away from there; hidden feet where they stood."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from mocapfix.contacts.contacts import CONTACT_JOINTS, BodyContacts, Floor
from mocapfix.contacts.foot_displacements import (
    MAX_DISPLACEMENT_ACCELERATION_M_S2,
    MAX_LOCK_DISPLACEMENT_M,
    Lock,
    compute_foot_displacements,
    compute_step_displacements,
    extend_contacts,
    limit_length,
    smooth_displacement,
)
from tests.contacts.walking_feet import find_true_stances, make_feet, walk

RATE, SECONDS = 120.0, 5.0
STANCES = walk()
IS_STANDING = np.repeat(np.stack([find_true_stances(foot, SECONDS, RATE) for foot in STANCES], axis=1), 2, axis=1)


def build_contacts(is_contact: np.ndarray = IS_STANDING, is_known: np.ndarray | None = None) -> BodyContacts:
    """Return contacts of the four joints of the feet."""
    known = np.ones(is_contact.shape, bool) if is_known is None else is_known
    return BodyContacts(CONTACT_JOINTS, is_contact, is_contact * 0.9, known, Floor(0.0, 0.0, (0.0,)), RATE)


def add_skin(feet: np.ndarray, sd_m: float = 0.004) -> np.ndarray:
    """Return the feet with a slow motion that both joints of a foot have in common."""
    rng = np.random.default_rng(0)
    skin = gaussian_filter1d(rng.normal(size=(len(feet), 2, 3)), 20, axis=0)
    return feet + np.repeat(sd_m * skin / skin.std(), 2, axis=1)


def measure_drift(position: np.ndarray, margin: int = 12) -> float:
    """Return the largest horizontal distance in metres from the mean place of a contact, without its borders."""
    drifts = [0.0]
    for c in range(4):
        inner = np.flatnonzero(IS_STANDING[:, c])
        for run in np.split(inner, np.flatnonzero(np.diff(inner) > 1) + 1):
            flat = position[run[margin:-margin], c][:, [0, 2]]
            if len(flat):
                drifts.append(np.linalg.norm(flat - flat.mean(0), axis=1).max())
    return max(drifts)


def test_locked_feet_stay_at_one_place_and_keep_their_height():
    feet = add_skin(make_feet(STANCES, SECONDS, RATE))
    displacement = compute_foot_displacements(feet, build_contacts(), is_locked=True)
    assert measure_drift(feet) > 0.003
    assert measure_drift(feet + displacement) < 0.0005
    np.testing.assert_allclose(displacement[..., 1], 0, atol=1e-12)


def test_soft_removes_fast_motion_and_keeps_slow_rolling():
    feet = np.tile(make_feet(STANCES, 0.1, RATE)[:1], (480, 1, 1))
    time_s = np.arange(480) / RATE
    fast, slow = 0.003 * np.sin(2 * np.pi * 4 * time_s), 0.01 * time_s
    moving = feet + np.stack([fast + slow, 0 * fast, 0 * fast], axis=1)[:, None]
    held = moving + compute_foot_displacements(moving, build_contacts(np.ones((480, 4), bool)), is_locked=False)
    np.testing.assert_allclose(held[120:-120, 0, 0] - feet[120:-120, 0, 0], slow[120:-120], atol=0.0003)


def test_feet_that_do_not_move_are_left_where_they_are():
    feet = make_feet(STANCES, SECONDS, RATE)
    for is_locked in (False, True):
        displacement = compute_foot_displacements(feet, build_contacts(), is_locked=is_locked)
        assert np.abs(displacement[20:-20]).max() < 0.001


def test_nothing_moves_without_contact():
    feet = add_skin(make_feet(STANCES, SECONDS, RATE))
    displacement = compute_foot_displacements(feet, build_contacts(np.zeros_like(IS_STANDING)), is_locked=True)
    np.testing.assert_allclose(displacement, 0, atol=1e-12)


@pytest.mark.parametrize("is_locked", [False, True])
def test_a_hidden_foot_stays_where_it_stood(is_locked):
    feet = np.tile(make_feet(STANCES, 0.1, RATE)[:1], (240, 1, 1))
    wrong, is_known = feet.copy(), np.ones((240, 4), bool)
    is_known[80:160, :2] = False
    wrong[80:160, :2] += [0.05, 0.04, 0.0]
    held = wrong + compute_foot_displacements(wrong, build_contacts(np.ones((240, 4), bool), is_known), is_locked=is_locked)
    np.testing.assert_allclose(held[90:150], feet[90:150], atol=0.001)


@pytest.mark.parametrize("is_locked", [False, True])
def test_a_foot_hidden_throughout_a_contact_stands_where_its_path_is_most_certain(is_locked):
    feet = np.tile(make_feet(STANCES, 0.1, RATE)[:1], (240, 1, 1))
    is_contact, is_known, sd = np.zeros((240, 4), bool), np.ones((240, 4), bool), np.full((240, 4), 0.004)
    is_known[70:170, :2], is_contact[80:140, :2] = False, True
    wrong = feet.copy()
    wrong[70:170, :2] += np.sin(np.pi * np.linspace(0, 1, 100))[:, None, None] * [0.2, 0.02, 0.1]
    sd[70:170, :2] = 0.004 + 0.1 * np.sin(np.pi * np.linspace(0, 1, 100))[:, None]
    held = wrong + compute_foot_displacements(wrong, build_contacts(is_contact, is_known), is_locked=is_locked, position_sd=sd)
    assert np.ptp(held[82:138, :2], axis=0).max() < 0.002  # at one place
    assert np.abs(held[82:138, :2] - feet[82:138, :2]).max() < 0.1  # nearer than on average: its path was right at the border
    np.testing.assert_allclose(held[:70, :2], feet[:70, :2], atol=0.002)  # what markers show is not moved
    np.testing.assert_allclose(held[180:, :2], feet[180:, :2], atol=0.002)
    np.testing.assert_allclose(held[:, 2:], feet[:, 2:], atol=1e-12)


def test_a_lock_moves_slow_visible_frames_for_a_contact_that_markers_show_alone():
    feet = np.tile(make_feet(STANCES, 0.1, RATE)[:1], (240, 1, 1))
    feet[:, :2, 0] += 0.1 * np.arange(240)[:, None] / RATE  # slow, and no contact
    is_contact, is_known = np.zeros((240, 4), bool), np.ones((240, 4), bool)
    is_contact[100:160, :2] = True
    moved = compute_foot_displacements(feet, build_contacts(is_contact, is_known), is_locked=True)
    assert np.linalg.norm(moved[80:100, 0], axis=1).min() > 0.025
    is_known[95:165, :2] = False
    moved = compute_foot_displacements(feet, build_contacts(is_contact, is_known), is_locked=True, position_sd=is_contact * 0.03)
    assert np.linalg.norm(moved[:90, 0], axis=1).max() < 0.005
    assert np.linalg.norm(np.ptp(feet[102:158, 0] + moved[102:158, 0], axis=0)) < 0.003


@pytest.mark.parametrize("is_locked", [False, True])
def test_a_hidden_contact_that_runs_across_a_step_has_two_places(is_locked):
    feet = np.tile(make_feet(STANCES, 0.1, RATE)[:1], (300, 1, 1))
    is_contact, is_known, sd = np.zeros((300, 4), bool), np.ones((300, 4), bool), np.full((300, 4), 0.03)
    is_known[70:230, :2], is_contact[80:220, :2] = False, True
    feet[:, :2, 2] += np.interp(np.arange(300), [130, 170], [0.0, 0.9])[:, None]
    held = feet + compute_foot_displacements(feet, build_contacts(is_contact, is_known), is_locked=is_locked, position_sd=sd)
    np.testing.assert_allclose(held[85:125, :2], feet[85:125, :2], atol=0.03)
    np.testing.assert_allclose(held[175:215, :2], feet[175:215, :2], atol=0.03)


@pytest.mark.parametrize("is_locked", [False, True])
def test_a_foot_that_is_lost_with_its_body_is_not_held(is_locked):
    still = np.tile(make_feet(STANCES, 0.1, RATE)[:1], (600, 1, 1))
    guessed, sd, is_known = still.copy(), np.full((600, 4), 0.004), np.ones((600, 4), bool)
    is_contact = np.zeros((600, 4), bool)
    is_known[80:, :2], is_contact[100:160, :2], is_contact[300:360, :2] = False, True, True
    guessed[80:] += 0.5 * np.maximum(np.arange(520) / RATE, 0)[:, None, None] * [1.0, 0.0, 0.0]
    sd[80:200, :2], sd[200:, :2] = 0.1, 20.0
    moved = compute_foot_displacements(guessed, build_contacts(is_contact, is_known), is_locked=is_locked, position_sd=sd)[:, :2]
    assert np.abs(moved[100:160]).max() > 0.05
    assert np.abs(moved).max() < 0.3
    assert np.abs(moved[360:]).max() < 0.03  # nothing is held there, and the displacement of the contact before ends


def test_displacement_begins_and_ends_smoothly():
    displacement = np.zeros((240, 1))
    displacement[80:160] = 0.02
    is_contact = displacement[:, 0] > 0
    smooth = smooth_displacement(displacement, is_contact, np.ones(240, bool), RATE)
    np.testing.assert_allclose(smooth[100:140], 0.02, atol=0.0005)
    assert abs(smooth[40, 0]) < 0.0005
    assert np.abs(np.diff(smooth[:, 0], 2)).max() < 0.001


def test_contacts_at_different_places_that_almost_touch_do_not_pop():
    displacement, is_contact = np.zeros((240, 3)), np.ones(240, bool)
    displacement[:118, 0], displacement[118:, 0] = 0.03, -0.01
    is_contact[118:124] = False
    smooth = smooth_displacement(displacement, is_contact, np.ones(240, bool), RATE)
    acceleration = np.linalg.norm(np.diff(smooth, 2, axis=0), axis=1) * RATE**2
    assert acceleration.max() < 2 * MAX_DISPLACEMENT_ACCELERATION_M_S2
    free = smooth_displacement(displacement, is_contact, np.zeros(240, bool), RATE)
    assert (np.linalg.norm(np.diff(free, 2, axis=0), axis=1) * RATE**2).max() > 4 * MAX_DISPLACEMENT_ACCELERATION_M_S2
    np.testing.assert_allclose(smooth[[60, 200], 0], [0.03, -0.01], atol=0.0005)


def build_path(speed_m_s: np.ndarray) -> np.ndarray:
    """Return a straight path with the speed of each frame."""
    return np.outer(np.cumsum(speed_m_s) / RATE, [1.0, 0.0, 0.0])


def test_contacts_extend_over_slow_frames_and_join():
    is_contact = np.zeros(100, bool)
    is_contact[30:40] = is_contact[45:60] = True
    speed = np.full(100, 0.1)
    speed[:25] = speed[71:] = 1.0
    assert np.flatnonzero(extend_contacts(is_contact, build_path(speed), RATE)).tolist() == list(range(25, 70))
    assert (extend_contacts(is_contact, build_path(np.ones(100)), RATE) == is_contact).all()


def test_a_joint_is_not_pulled_far():
    feet = np.tile(make_feet(STANCES, 0.1, RATE)[:1], (480, 1, 1)) + np.linspace(0, 0.3, 480)[:, None, None] * [1.0, 0, 0]
    displacement = compute_foot_displacements(feet, build_contacts(np.ones((480, 4), bool)), is_locked=True)
    assert np.linalg.norm(displacement, axis=-1).max() < 1.1 * MAX_LOCK_DISPLACEMENT_M


def test_a_lock_of_animations_holds_feet_that_shake_and_drift_far():
    feet = add_skin(make_feet(STANCES, SECONDS, RATE), 0.02)
    exact = compute_foot_displacements(feet, build_contacts(), is_locked=True, lock=Lock(1.0, 10_000.0, 12.0))
    assert measure_drift(feet + exact) < 0.25 * measure_drift(
        feet + compute_foot_displacements(feet, build_contacts(), is_locked=True)
    )


def build_slide(speed_m_s: float) -> np.ndarray:
    return np.arange(round(SECONDS * RATE))[:, None] / RATE * [0.0, 0.0, speed_m_s]


def test_feet_that_slide_are_held_in_the_middle_and_steps_are_stretched():
    feet, slide = make_feet(STANCES, SECONDS, RATE), build_slide(0.1)
    displacement = compute_step_displacements(feet, build_contacts(), slide)
    held = feet + slide[:, None] + displacement
    assert measure_drift(feet + slide[:, None]) > 0.03
    assert measure_drift(held, margin=1) < 1e-9
    for c in range(4):
        for run in np.split(
            np.flatnonzero(IS_STANDING[:, c]), np.flatnonzero(np.diff(np.flatnonzero(IS_STANDING[:, c])) > 1) + 1
        ):
            np.testing.assert_allclose(displacement[run, c].mean(0), 0.0, atol=1e-9)
    acceleration = [np.abs(np.diff(path, 2, axis=0)).max() for path in (feet, held)]
    assert acceleration[1] < 1.3 * acceleration[0]


def test_contacts_between_which_a_foot_stays_are_one_place():
    feet, slide = make_feet(STANCES, SECONDS, RATE), build_slide(0.1)
    is_contact = IS_STANDING.copy()
    is_contact[20:24] = False
    held = feet + slide[:, None] + compute_step_displacements(feet, build_contacts(is_contact), slide)
    assert measure_drift(held, margin=1) < 0.001


def test_a_foot_that_never_stands_follows_the_body():
    feet, slide = make_feet(STANCES, SECONDS, RATE), build_slide(0.1)
    assert not compute_step_displacements(feet, build_contacts(np.zeros_like(IS_STANDING)), slide).any()
    once = np.zeros_like(IS_STANDING)
    once[300:330] = IS_STANDING[300:330]
    assert np.abs(compute_step_displacements(feet, build_contacts(once), slide)).max() < 0.5


def test_long_vectors_are_shortened():
    np.testing.assert_allclose(
        limit_length(np.array([[3.0, 0, 4], [0.3, 0, 0.4], [0, 0, 0]]), 1.0), [[0.6, 0, 0.8], [0.3, 0, 0.4], [0, 0, 0]]
    )


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_very_short_takes(frames):
    feet = make_feet(STANCES, 0.2, RATE)[:frames]
    displacement = compute_foot_displacements(feet, build_contacts(np.ones((frames, 4), bool)), is_locked=True)
    np.testing.assert_allclose(displacement, 0, atol=1e-9)
