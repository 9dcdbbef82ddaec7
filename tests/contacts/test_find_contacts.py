"""Contacts of feet, knees, hands, seat and back: known times, steps, tilted floors, all rates, and bodies without feet."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from mocapfix.contacts.contacts import CONTACT_JOINTS, NO_FLOOR, OTHER_CONTACT_JOINTS, Floor
from mocapfix.contacts.find_contacts import (
    MIN_CONTACT_PROBABILITY,
    estimate_slide,
    find_contacts,
    find_foot_contacts,
    find_frames_near_floor,
    find_other_contacts,
    find_shown_standing,
    replace_contacts,
)
from mocapfix.lab.sound_takes import build_known_motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.stats.sequences import find_runs
from tests.contacts.walking_feet import find_true_stances, make_feet, tilt, walk

SKELETON = load_cmu31_body().skeleton
SECONDS = 5.5


def find(feet: np.ndarray, rate: float, sd: np.ndarray | None = None):
    """Return the contacts of the paths (T, 4, 3) of feet."""
    return find_foot_contacts(feet, np.full(feet.shape[:2], 0.003) if sd is None else sd, rate)


def compute_agreement(contacts, stances, rate: float) -> float:
    """Return the F1 by frame of all four joints."""
    true = np.repeat(np.stack([find_true_stances(foot, SECONDS, rate) for foot in stances], axis=1), 2, axis=1)
    return 2 * (contacts.is_contact & true).sum() / (contacts.is_contact.sum() + true.sum())


@pytest.mark.parametrize("rate", [25.0, 30.0, 60.0, 120.0, 250.0, 500.0])
def test_walk_at_every_rate(rate):
    stances = walk()
    contacts = find(make_feet(stances, SECONDS, rate), rate)
    assert compute_agreement(contacts, stances, rate) > (0.93 if rate < 50 else 0.97)
    assert contacts.floor.level_heights_m == pytest.approx((0.0,), abs=0.003)


@pytest.mark.parametrize("step_height_m", [0.17, -0.17])
def test_stairs_are_levels_with_contacts_on_each(step_height_m):
    stances = walk(step_height_m)
    contacts = find(make_feet(stances, SECONDS, 120.0), 120.0)
    heights = sorted(foot[2][1] - 0.025 for side in stances for foot in side)
    # where both feet stand still at the end, or at the beginning, the upper one may as well be held in the air
    assert set(np.round(heights[1:-1], 2)) <= set(np.round(contacts.floor.level_heights_m, 2)) <= set(np.round(heights, 2))
    true = np.repeat(np.stack([find_true_stances(foot, SECONDS, 120.0) for foot in stances], axis=1), 2, axis=1)
    inner = slice(round(1.1 * 120), round(3.6 * 120))
    assert (contacts.is_contact == true)[inner].mean() > 0.97


@pytest.mark.parametrize("step_height_m", [0.08, -0.08])
def test_steps_that_are_too_low_for_levels_have_contacts(step_height_m):
    stances = walk(step_height_m)
    contacts = find(make_feet(stances, SECONDS, 120.0), 120.0)
    true = np.repeat(np.stack([find_true_stances(foot, SECONDS, 120.0) for foot in stances], axis=1), 2, axis=1)
    inner = slice(round(1.1 * 120), round(3.6 * 120))
    assert (contacts.is_contact == true)[inner].mean() > 0.97


@pytest.mark.parametrize("seed", range(4))
def test_uneven_ground_has_contacts(seed):
    rng = np.random.default_rng(seed)
    stances = tuple([(first, last, (x, y + rng.uniform(-0.1, 0.1), z)) for first, last, (x, y, z) in foot] for foot in walk())
    assert compute_agreement(find(make_feet(stances, SECONDS, 120.0), 120.0), stances, 120.0) > 0.97


@pytest.mark.parametrize("tilt_deg", [3.0, 8.0, 15.0])
def test_tilted_floor(tilt_deg):
    stances = walk()
    contacts = find(tilt(make_feet(stances, SECONDS, 120.0), tilt_deg), 120.0)
    assert compute_agreement(contacts, stances, 120.0) > 0.96
    assert contacts.floor.tilt_deg == pytest.approx(tilt_deg, abs=0.1)


@pytest.mark.parametrize("sd_m", [0.0002, 0.0005])
def test_noise_does_not_hide_contacts(sd_m):
    stances = walk()
    feet = make_feet(stances, SECONDS, 120.0)
    noisy = feet + np.random.default_rng(0).normal(0, sd_m, feet.shape)
    assert compute_agreement(find(noisy, 120.0), stances, 120.0) > 0.95


def test_the_same_foot_hidden_while_it_stands_is_in_contact():
    stances = walk(stance_s=1.5)
    feet, sd = make_feet(stances, SECONDS, 120.0), np.full((round(SECONDS * 120), 4), 0.003)
    hidden = slice(150, 220)
    feet[hidden, :2] += np.random.default_rng(0).normal(0, 0.05, (70, 2, 3))
    sd[hidden, :2] = 0.02
    contacts = find(feet, 120.0, sd)
    assert contacts.is_contact[hidden, :2].all()
    assert not contacts.is_known[hidden, :2].any()
    assert contacts.is_known[:, 2:].all()


def test_a_foot_that_is_held_in_the_air_has_no_probability_of_a_contact():
    feet = stand_and_raise(0.28, 0.225)
    feet[125:140, 2:] = np.linspace(feet[124, 2:], feet[140, 2:], 15)
    contacts = find(feet, 120.0)
    assert (contacts.probability[:100] > 0.9).all()
    assert not contacts.probability[150:, 2:].any()
    assert (contacts.probability[contacts.is_contact] > MIN_CONTACT_PROBABILITY).all()
    assert (contacts.probability[~contacts.is_contact] <= 0.5).all()


def stand_and_raise(right_ankle_m: float, right_toe_m: float) -> np.ndarray:
    """Return feet (200, 4, 3) that stand, the right one with these heights after 140 frames."""
    feet = np.zeros((200, 4, 3))
    feet[..., 1] = 0.08, 0.025, 0.08, 0.025
    feet[140:, 2:, 1] = right_ankle_m, right_toe_m
    return feet


@pytest.mark.parametrize(
    ("ankle_m", "toe_m", "is_left_standing", "is_near"),
    [
        (0.28, 0.225, True, (False, False)),  # held in the air
        (0.18, 0.025, True, (False, True)),  # on its toes
        (0.18, 0.125, False, (True, True)),  # on a low step
        (0.28, 0.125, False, (False, True)),  # on its toes on a low step
        (0.08, 0.1, False, (True, False)),  # on its heel
    ],
)
def test_a_foot_is_near_the_floor_or_bears_weight_where_it_stands(ankle_m, toe_m, is_left_standing, is_near):
    is_standing = np.ones((200, 4), bool)
    is_standing[140:, :2] = is_left_standing
    is_standing[139, 2:] = False
    found = find_frames_near_floor(stand_and_raise(ankle_m, toe_m), is_standing, Floor(0.0, 0.0, (0.0,)))
    assert found[:139].all()
    assert (found[140:, 2:] == is_near).all()


def test_the_heel_of_a_foot_that_is_mostly_on_its_ball_is_not_near():
    feet, is_standing = stand_and_raise(0.22, 0.08), np.ones((200, 4), bool)
    feet = feet[120:]  # 20 frames flat, 60 on the ball, whose toes are higher than a level allows
    is_standing = is_standing[120:]
    is_standing[20:, :2] = is_standing[19, 2:] = False
    found = find_frames_near_floor(feet, is_standing, Floor(0.0, 0.0, (0.0,)))
    assert not found[20:, 2].any()
    assert found[20:, 3].all()


def test_without_a_floor_or_a_stance_nothing_is_near():
    feet, nothing = stand_and_raise(0.08, 0.025), np.zeros((200, 4), bool)
    assert not find_frames_near_floor(feet, nothing, Floor(0.0, 0.0, (0.0,))).any()
    assert not find_frames_near_floor(feet, ~nothing, NO_FLOOR).any()


@pytest.mark.parametrize(("height_m", "speed_m_s", "is_contact"), [(0.06, 0.0, True), (0.06, 0.5, False), (0.5, 0.0, False)])
def test_knees_and_hands_are_in_contact_where_they_rest_on_the_floor(height_m, speed_m_s, is_contact):
    position = np.zeros((200, 1, 3))
    position[:, 0, 1] = height_m
    position[:, 0, 2] = speed_m_s * np.arange(200) / 120.0
    found, probability = find_other_contacts(position, np.zeros((200, 2, 3)), Floor(0.0, 0.0, (0.0,)), 120.0)
    assert found.all() == found.any() == is_contact
    assert (probability > 0.9).all() == is_contact


def test_a_knee_beside_a_step_is_in_contact_only_where_the_feet_are_on_the_step():
    floor, position, toes = Floor(0.0, 0.0, (0.0, 0.45)), np.full((200, 1, 3), 0.5), np.zeros((200, 2, 3))
    assert not np.any(find_other_contacts(position, toes, floor, 120.0))
    toes[:, :, 1] = 0.47
    assert find_other_contacts(position, toes, floor, 120.0)[0].all()


def test_a_body_that_sits_on_the_floor_rests_on_its_seat():
    motion, position = place_body(120)
    position[:, SKELETON.names.index("Hips"), 1] = 0.09
    contacts = find_contacts(SKELETON, motion, position, 120.0)
    assert [joint for joint in OTHER_CONTACT_JOINTS if contacts.is_contact[:, contacts.joints.index(joint)].any()] == ["Hips"]


def place_body(frames: int):
    """Return a still body, standing, as motion and joint positions."""
    motion = build_known_motion(np.zeros((frames, 3)), np.tile(np.eye(3), (frames, len(SKELETON.names), 1, 1)))
    motion = replace(motion, joint_sd=np.full((frames, len(SKELETON.names)), 0.003))
    position = np.tile(np.cumsum(np.full((len(SKELETON.names), 3), 0.001), axis=0), (frames, 1, 1))
    for joint, height_m in {"LeftFoot": 0.08, "LeftToeBase": 0.025, "RightFoot": 0.08, "RightToeBase": 0.025}.items():
        position[:, SKELETON.names.index(joint), 1] = height_m
    for joint in OTHER_CONTACT_JOINTS:
        position[:, SKELETON.names.index(joint), 1] = 0.5
    return motion, position


def test_a_still_body_stands_on_both_feet_alone():
    motion, position = place_body(120)
    contacts = find_contacts(SKELETON, motion, position, 120.0)
    assert contacts.joints == (*CONTACT_JOINTS, *OTHER_CONTACT_JOINTS)
    assert contacts.is_contact[:, :4].all()
    assert not contacts.is_contact[:, 4:].any()


def test_feet_above_the_hips_and_those_of_a_body_that_no_marker_shows_do_not_stand():
    motion, position = place_body(240)
    position[:120, SKELETON.names.index("Hips"), 1] = 0.02  # lies, with its toes up
    position[:120, [SKELETON.names.index(joint) for joint in CONTACT_JOINTS], 1] = 0.2
    contacts = find_contacts(SKELETON, motion, position, 120.0)
    assert contacts.floor.level_heights_m == pytest.approx((0.0,))
    assert not contacts.is_contact[:115, :4].any()
    assert contacts.is_contact[125:, :4].all()
    motion, position = place_body(240)
    motion.joint_sd[120:] = 0.05
    contacts = find_contacts(SKELETON, motion, position, 120.0)
    assert contacts.is_contact[:120, :4].all()
    assert not contacts.is_contact[120:].any()


def test_a_body_without_feet_has_no_contacts():
    motion, position = place_body(120)
    position[:, SKELETON.names.index("LeftFoot")] = np.nan
    contacts = find_contacts(SKELETON, motion, position, 120.0)
    assert not contacts.is_contact.any()
    assert contacts.floor is NO_FLOOR


def test_joints_that_are_not_shown_do_not_hide_the_contacts_of_others():
    motion, position = place_body(120)
    hands, knee = ([SKELETON.names.index(joint) for joint in joints] for joints in (OTHER_CONTACT_JOINTS[2:4], ["LeftLeg"]))
    position[:, hands] = motion.joint_sd[:, hands] = np.nan
    position[:, knee, 1] = 0.05
    contacts = find_contacts(SKELETON, motion, position, 120.0)
    found = [joint for n, joint in enumerate(contacts.joints) if contacts.is_contact[:, n].any()]
    assert found == [*CONTACT_JOINTS, "LeftLeg"]
    assert not contacts.is_known[:, 6:8].any()
    assert contacts.is_known[:, [0, 1, 2, 3, 4, 5, 8, 9]].all()


@pytest.mark.parametrize("frames", [0, 1, 2, 3, 5])
def test_very_short_takes(frames):
    motion, position = place_body(frames)
    contacts = find_contacts(SKELETON, motion, position, 120.0)
    assert len(contacts.is_contact) == frames
    assert not contacts.is_contact.any()


@pytest.mark.parametrize("depth_m", [0.01, 0.03, 0.05])
@pytest.mark.parametrize("delay_s", [0.05, 0.2])
def test_the_height_of_a_foot_in_a_soft_mat_is_no_evidence_against_its_contact(depth_m, delay_s):
    stances, rate = walk(), 120.0
    is_standing = np.stack([find_true_stances(foot, SECONDS, rate) for foot in stances], axis=1)
    load, sunk = is_standing / is_standing.sum(1, keepdims=True), np.zeros(is_standing.shape)
    for t in range(1, len(sunk)):  # the mat yields to the load and recovers with a delay
        sunk[t] = sunk[t - 1] + (load[t] - sunk[t - 1]) / (delay_s * rate)
    feet, sunk = make_feet(stances, SECONDS, rate), np.repeat(sunk, 2, axis=1)
    feet[..., 1] -= depth_m * sunk
    contacts, is_standing = find(feet, rate), np.repeat(is_standing, 2, axis=1)
    np.testing.assert_array_equal(contacts.is_contact, find_shown_standing(feet, np.zeros(feet.shape[:2]), rate)[0])
    is_still = is_standing & (np.abs(np.gradient(depth_m * sunk, 1 / rate, axis=0)) < 0.05)
    assert contacts.is_contact[is_still].mean() > 0.85
    assert is_standing[contacts.is_contact].mean() > 0.97
    assert len(contacts.floor.level_heights_m) == 1


def build_stretched_walk(stretch: float, rate: float = 120.0, step_height_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the hips and the feet of a walk whose path is longer than its steps by a share."""
    feet = make_feet(walk(step_height_m, stance_s=0.6), SECONDS, rate)
    hips = gaussian_filter1d(feet[:, [1, 3]].mean(1), 0.4 * rate, axis=0, mode="nearest")
    slide = stretch * (hips - hips[0]) * [1.0, 0.0, 1.0]
    return hips + slide, feet + slide[:, None]


@pytest.mark.parametrize("stretch", [0.15, 0.25, -0.2])
@pytest.mark.parametrize("rate", [30.0, 120.0])
def test_the_slide_of_a_stretched_walk_is_found_and_its_contacts_are_those_of_the_walk(stretch, rate):
    hips, feet = build_stretched_walk(stretch, rate)
    found = find(feet, rate)
    slide = estimate_slide(hips, feet[:, [1, 3]], found, is_given=False)
    expected = (hips - build_stretched_walk(0.0, rate)[0])[:, 2]
    np.testing.assert_allclose(slide.path[:, 2], expected, atol=0.1 * abs(expected).max())
    true = find(build_stretched_walk(0.0, rate)[1], rate)
    contacts = find(feet - slide.path[:, None], rate)
    assert (contacts.is_contact == true.is_contact).mean() > 0.95
    assert (found.is_contact == true.is_contact).mean() < 0.9
    assert (slide.is_support & ~true.is_contact[:, [1, 3]]).mean() < 0.02


def test_toes_that_roll_forward_do_not_hide_that_the_path_is_too_short():
    hips, feet = build_stretched_walk(-0.1)
    true, roll_m = find(build_stretched_walk(0.0)[1], 120.0), 0.012
    for toes in (1, 3):
        runs = find_runs(true.is_contact[:, toes])
        frames = [frame for first, last in runs for frame in (last - 0.4 * (last - first), last, last + 30)]
        feet[:, toes, 2] += np.interp(np.arange(len(feet)), frames, np.tile([0, roll_m, 0], len(runs)))
    found = find(feet, 120.0)
    path = estimate_slide(hips, feet[:, [1, 3]], found, is_given=False).path[:, 2]
    np.testing.assert_allclose(path[-1], -0.1 / 0.9 * (hips[-1] - hips[0])[2], rtol=0.1)


@pytest.mark.parametrize("step_height_m", [0.0, 0.17])
def test_feet_that_stand_do_not_slide(step_height_m):
    hips, feet = build_stretched_walk(0.0, step_height_m=step_height_m)
    assert not estimate_slide(hips, feet[:, [1, 3]], find(feet, 120.0), is_given=False).path.any()
    still = np.tile(feet[:1], (len(feet), 1, 1))
    assert not estimate_slide(np.tile(hips[:1], (len(feet), 1)), still[:, [1, 3]], find(still, 120.0), is_given=False).path.any()
    assert not estimate_slide(hips[:1], feet[:1, [1, 3]], find(feet[:1], 120.0), is_given=False).path.any()


def test_a_foot_that_bears_weight_and_shakes_is_a_support_also_where_the_path_fits():
    hips, feet = build_stretched_walk(0.0)
    true = find(feet, 120.0).is_contact[:, [1, 3]]
    alone = true & ~true[:, ::-1]  # the other foot swings
    noisy = feet + 0.003 * np.sin(2 * np.pi * 8 * np.arange(len(feet)) / 120.0)[:, None, None] * [1.0, 0.0, 0.0]
    found = find(noisy, 120.0)
    slide = estimate_slide(hips, noisy[:, [1, 3]], found, is_given=False)
    assert not slide.path.any()
    assert found.is_contact[:, [1, 3]][alone].mean() < 0.5 < 0.7 < slide.is_support[alone].mean()
    assert slide.is_support[~true].mean() < 0.05
    fast = feet + 0.01 * np.sin(2 * np.pi * 8 * np.arange(len(feet)) / 120.0)[:, None, None] * [1.0, 0.0, 0.0]
    assert not estimate_slide(hips, fast[:, [1, 3]], find(fast, 120.0), is_given=False).is_support.any()


def test_in_given_contacts_any_slide_counts():
    hips, feet = build_stretched_walk(0.02)
    true = find(build_stretched_walk(0.0)[1], 120.0)
    path = estimate_slide(hips, feet[:, [1, 3]], true, is_given=True).path[:, 2]
    np.testing.assert_allclose(path[-1], 0.02 / 1.02 * (hips[-1] - hips[0])[2], rtol=0.2)


def test_given_contacts_replace_those_that_were_found_and_show_the_floor():
    _, feet = build_stretched_walk(0.15)
    is_left, is_knee = np.zeros(len(feet), bool), np.zeros(len(feet), bool)
    is_left[:60], is_knee[200:230] = True, True
    contacts = replace_contacts(find(feet, 120.0), {"LeftToeBase": is_left, "RightLeg": is_knee}, feet[:, [1, 3]])
    assert contacts.joints == (*CONTACT_JOINTS, *OTHER_CONTACT_JOINTS)
    assert contacts.list_intervals("LeftToeBase") == [(0, 59)]
    assert contacts.list_intervals("RightLeg") == [(200, 229)]
    assert contacts.list_intervals("RightFoot") == []
    assert contacts.floor.level_heights_m == pytest.approx((0.0,), abs=0.003)
