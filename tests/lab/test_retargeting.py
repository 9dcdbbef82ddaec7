"""The benchmark of retargeting: characters beside the landmarks and markers of a performer."""

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.characters.character import build_cmu31_character, convert_motion
from mocapfix.characters.character_files import write_character_glb
from mocapfix.characters.load_character import load_character, load_character_preset
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.errors import TakeError
from mocapfix.lab.retargeting import (
    MIN_PEAK_M_S2,
    BenchMotion,
    compute_accelerations,
    find_foot_corners,
    find_landmarks,
    find_marker_middles,
    load_bench_motions,
    measure_characters,
    measure_motion,
    scale_by_limb,
    summarise_quantity,
)
from mocapfix.synthetic import compose_take
from tests.characters.walking_body import build_contacts


@pytest.fixture(scope="module")
def take():
    return compose_take(seed=3, seconds=2.0)


@pytest.fixture(scope="module")
def performed(take) -> BenchMotion:
    """Two seconds of walking, with the middles of the true markers."""
    skeleton, middles = take.subject.skeleton, find_marker_middles(take.subject, take.labels, take.marker_positions)
    contacts = build_contacts(skeleton, take.motion, take.rate)
    return BenchMotion("walk", skeleton, convert_motion(take.motion, take.rate), contacts, middles)


@pytest.fixture(scope="module")
def performer(performed):
    return find_landmarks(build_cmu31_character(performed.skeleton), performed.motion, {})


def find_largest(quantities) -> dict[str, float]:
    return {name: max(float(np.nanmax(each)) for each in places.values()) for name, places in quantities.items()}


def test_the_performer_is_right(performed, performer):
    """The elbow and the knee have one marker each, at the side, so lines between markers are some degrees off."""
    largest = find_largest(measure_motion(performed, performer, performer))
    for name in ("upper_arm_deg", "forearm_deg", "thigh_deg", "shin_deg", "in_body_mm", "free_hand_mm"):
        assert largest[name] == pytest.approx(0.0, abs=1e-6)
    assert largest["acceleration_ratio"] <= 1.0
    assert 1.0 < largest["shin_to_markers_deg"] < 12.0


def test_the_wrist_is_at_the_middle_of_its_markers(take, performed, performer):
    pair = [take.labels.index(label) for label in ("LWRA", "LWRB")]
    np.testing.assert_array_equal(performed.markers["left_hand"], take.marker_positions[:, pair].mean(axis=1))
    distance = np.linalg.norm(performed.markers["left_hand"] - performer.places["left_hand"], axis=1)
    assert distance.max() < 0.08  # markers are on the skin, and a bar holds them off


def test_a_bent_wrong_forearm_is_seen(performed, performer):
    """The left elbow of the figure is turned by 10 degrees across the forearm."""
    wrist, elbow = performer.places["left_hand"], performer.places["left_forearm"]
    line = wrist - elbow
    across = np.cross(line, [0.3, 1.0, 0.2])
    across *= np.linalg.norm(line, axis=1, keepdims=True) / np.linalg.norm(across, axis=1, keepdims=True)
    turned = elbow + np.cos(np.deg2rad(10)) * line + np.sin(np.deg2rad(10)) * across
    quantities = measure_motion(performed, performer, performer._replace(places=performer.places | {"left_hand": turned}))
    np.testing.assert_allclose(quantities["forearm_deg"]["left"], 10.0, atol=1e-6)
    assert quantities["forearm_deg"]["right"].max() < 1e-6


def test_a_pop_is_compared_with_the_largest_acceleration_of_the_performer(performed, performer):
    """A knee is 100 mm off in one frame of 120 a second: 1440, 2880 and 1440 m/s2, of which the second smallest counts."""
    knee = performer.places["left_shin"].copy()
    knee[100] += [0.0, 0.0, 0.1]
    quantities = measure_motion(performed, performer, performer._replace(places=performer.places | {"left_shin": knee}))
    own = max(float(compute_accelerations(performer.places["left_shin"], 120.0).max()), MIN_PEAK_M_S2)
    assert quantities["acceleration_ratio"]["left_shin"].max() == pytest.approx(1440 / own, abs=1.1)
    row = summarise_quantity("acceleration_ratio", [("walk", quantities)])
    assert row["where"] in ("walk: left_shin, frame 99", "walk: left_shin, frame 100")


def test_limbs_of_other_lengths_are_compared_with_the_performer_of_these_lengths(performer):
    """A figure with twice the height and four times the length of each thigh has its knees below the scaled hips."""
    places = {name: 2.0 * place for name, place in performer.places.items()}
    for side in ("left", "right"):
        for name in ("shin", "foot", "ball"):
            places[f"{side}_{name}"] += 2.0 * (performer.places[f"{side}_shin"] - performer.places[f"{side}_thigh"])
    scaled = scale_by_limb(performer, performer._replace(places=places, leg_m=2.0 * performer.leg_m))
    for name in ("left_ball", "right_shin", "left_hand", "head"):
        np.testing.assert_allclose(scaled[name], places[name], atol=0.01)


def test_a_palm_below_its_clearance_is_in_the_floor(performed, performer):
    """The performer's palm is higher than the half thickness of a hand, 30 mm; the figure's is 50 mm below the floor."""
    floor = performed.contacts.floor
    palm = performer.places["left_palm"].copy()
    palm[:, 1] = -0.05
    quantities = measure_motion(performed, performer, performer._replace(places=performer.places | {"left_palm": palm}))
    assert floor.level_heights_m
    np.testing.assert_allclose(quantities["in_floor_mm"]["left_palm"], 80.0, atol=1e-6)


def test_a_mesh_stands_on_its_lowest_corners(tmp_path, performed):
    """The test skin of a preset is a pyramid along each bone, whose corners of feet are on bones of feet."""
    preset = load_character_preset("mixamo")
    motion = retarget_motion(build_cmu31_character(performed.skeleton), performed.motion, preset)
    write_character_glb(tmp_path / "walk.glb", preset, motion, "walk")
    assert find_foot_corners(preset) == {}
    character = load_character(tmp_path / "walk.glb")
    corners = find_foot_corners(character)
    assert {character.skeleton.names[bone].split(":")[1][:8] for bone in corners} >= {"LeftFoot", "RightFoo"}
    landmarks = find_landmarks(character, motion, corners)
    ankle = landmarks.places["left_foot"][:, 1] - landmarks.soles_m["left"]
    assert 0.0 < ankle.min() < ankle.max() < 0.35
    assert not np.allclose(landmarks.soles_m["left"], find_landmarks(character, motion, {}).soles_m["left"])


def test_figures_move_like_the_performer(performed):
    results = measure_characters([performed], ["smpl"], lambda _: None)
    assert list(results["slide_mm_s"]) == ["performer", "smpl", "short legs", "long legs", "long arms"]
    assert results["thigh_deg"]["performer"]["largest"] == 0.0
    assert 0.0 < results["forearm_deg"]["smpl"]["mean"] < 4.0
    assert list(results["frames_per_second"]) == ["smpl", "short legs", "long legs", "long arms"]


def test_captures_without_a_whole_body_are_refused(tmp_path):
    (tmp_path / "empty.c3d").write_bytes(b"")
    with pytest.raises(TakeError, match="no C3D file in this folder shows a whole body"):
        load_bench_motions(None, tmp_path, "soft")


def test_captures_are_solved(tmp_path, monkeypatch, cleaned):
    (tmp_path / "walk.c3d").touch()
    monkeypatch.setattr(pipeline, "clean", lambda *_: cleaned.result)
    (motion,) = load_bench_motions(None, tmp_path, "soft")
    assert motion.name == "walk"
    assert set(motion.markers) == {f"{side}_{name}" for side in ("left", "right") for name in ("forearm", "hand", "shin", "foot")}
    assert motion.motion.frame_count == cleaned.truth.motion.frame_count
