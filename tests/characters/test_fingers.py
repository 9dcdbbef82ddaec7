"""Fingers of characters: which bones they are, and hands of known poses on hands of other shapes."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import measure_hand_poses
from mocapfix.characters.character import FINGERS, SIDES, compute_character_poses
from mocapfix.characters.character_files import CharacterFiles, convert_hand_motion, measure_animation_hands, write_character_bvh
from mocapfix.characters.character_yaml import read_mapping_file, write_mapping_file
from mocapfix.characters.fingers import HandPoses, compute_straight_finger, find_fingers, find_palms, has_named_fingers
from mocapfix.characters.load_character import load_character
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.errors import SceneError
from mocapfix.hands.hand_model import HAND_JOINTS, RAY_ROOTS, load_hand
from mocapfix.hands.solve_hands import attach_hands, solve_hand
from mocapfix.io.bvh import read_bvh, write_bvh_tree
from mocapfix.model.skeleton import Skeleton, decompose_transforms
from mocapfix.options import CHARACTER_PRESETS, OutputOptions, ReadOptions
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses, compute_world_poses
from tests.characters.walking_body import load_walk
from tests.hands.composed_hands import FRAMES, RATE_HZ, build_hand, carry_markers, compose_poses
from tests.hands.test_attach_hands import compose_hands_on_body

CLOSE_DEG = 1.0


def add_hands(character, joints=3, metacarpals=False, seed=None, fingers=FINGERS):
    """Return a character without fingers with those of the average hand, bent by up to 15 degrees in the rest pose.

    Of two joints the second spans the last two bones. Each bone has axes of its own with a `seed`, and a tip without joint. The
    names are those of SMPL-X.
    """
    rng = np.random.default_rng(0 if seed is None else seed)
    positions, rotations = (list(each) for each in character.skeleton.compute_rest_pose())
    tree, parents, ends = list(character.skeleton.names), character.skeleton.parents.tolist(), list(character.skeleton.ends)
    for side in SIDES:
        model, hand = load_hand("Left" if side == "left" else "Right"), character.mapping.bones[f"{side}_hand"][0]
        rest = np.tile(model.skeleton.rest_rotations, (1, 1, 1, 1))
        bend = model.compute_angles(np.array([0.0, 0.0, np.radians(15.0)]))
        rest[:, HAND_JOINTS] = rest[:, HAND_JOINTS] @ Rotation.from_rotvec(rng.uniform(size=(15, 1)) * bend).as_matrix()
        places = compute_tree_poses(build_kinematic_tree(model.skeleton), np.zeros((1, 3)), rest)
        for finger in fingers:
            root = int(RAY_ROOTS[FINGERS.index(finger)])
            tip = places[0][0, root + 3] + places[1][0, root + 3] @ model.skeleton.ends[root + 3]
            points = [*places[0][0, [root + 1, root + 2, root + 3]], tip]
            points = [points[0], *points[4 - joints :]]
            if metacarpals and finger != "thumb":
                points = [0.25 * points[0], *points]
            above = hand
            for k, (start, end) in enumerate(pairwise(points)):
                axes = Rotation.random(rng=rng).as_matrix() if seed is not None else np.eye(3)
                number = k + (not (metacarpals and finger != "thumb"))
                tree.append(f"{side}_{finger}{number or '_metacarpal'}")
                parents.append(above)
                positions.append(positions[hand] + start)
                rotations.append(axes)
                ends.append(axes.T @ (end - start))
                above = len(tree) - 1
    order = np.array(parents)
    skeleton = Skeleton(
        tuple(tree), order, *_split(np.array(positions), np.array(rotations), order, np.array(ends)),
    )  # fmt: skip
    grown = replace(character, skeleton=skeleton, scales=np.ones(len(tree)))
    found = find_fingers(skeleton.names, order, skeleton.rest_positions, character.mapping.bones)
    return replace(grown, mapping=replace(character.mapping, fingers=found))


def _split(positions, rotations, parents, ends):
    offsets, rest = decompose_transforms(positions, rotations, parents)
    return offsets, ends, rest


def compose_hands(count):
    """Return the poses of both hands over some frames: known angles of the average hand, on the palms of a walk."""
    hands = {}
    for side in ("Left", "Right"):
        hand = build_hand(side)
        palm, poses = compose_poses(hand, seed=len(hands))
        markers = carry_markers(hand, poses)
        solved = solve_hand(hand, markers, np.ones(markers.shape[:2], bool), palm, RATE_HZ)
        found = convert_hand_motion(solved, RATE_HZ, RATE_HZ)
        every = np.arange(count) % FRAMES
        fingers = {name: each[every] for name, each in found.fingers.items()}
        hands[side.lower()] = HandPoses(found.palm[every], fingers, found.position[every], found.offsets)
    return hands


def measure_directions(character, motion, side, finger):
    """Return the directions of the bones of a finger relative to the palm's, from the positions of joints and tips."""
    positions, rotations = compute_character_poses(character, motion)
    bones = character.mapping.fingers[f"{side}_{finger}"]
    tip = positions[:, bones[-1]] + rotations[:, bones[-1]] @ character.skeleton.ends[bones[-1]]
    points = np.stack([*(positions[:, bone] for bone in bones), tip], axis=1)
    vectors = np.diff(points, axis=1)
    return vectors / np.linalg.norm(vectors, axis=2, keepdims=True)


def compute_angles_deg(one, other):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(one, other), axis=-1), (one * other).sum(-1)))


@pytest.fixture(scope="module")
def walk():
    character, motion = load_walk()
    return character, motion, compose_hands(motion.frame_count)


@pytest.mark.parametrize("name", [name for name in CHARACTER_PRESETS if name != "smpl"])
def test_fingers_of_presets_are_found(name):
    fingers = load_character(name).mapping.fingers
    assert set(fingers) == {f"{side}_{finger}" for side in SIDES for finger in FINGERS}
    assert {len(chain) for chain in fingers.values()} == {3}
    names = load_character(name).skeleton.names
    for key, chain in fingers.items():
        finger = {"pinky": "pink|little", "middle": "mid"}.get(key.partition("_")[2], key.partition("_")[2])
        assert any(word in names[chain[-1]].lower() for word in finger.split("|"))


HAND_BONES = {
    "HumanIK": ["InHand{0}", "Hand{0}1", "Hand{0}2", "Hand{0}3", "Hand{0}4"],
    "Unreal": ["{0}_metacarpal", "{0}_01", "{0}_02", "{0}_03"],
    "Rigify": ["palm.{1}", "f_{0}.01", "f_{0}.02", "f_{0}.03"],
    "OpenXR": ["{0}_metacarpal", "{0}_proximal", "{0}_intermediate", "{0}_distal", "{0}_tip"],
    "Mixamo": ["Hand{0}1", "Hand{0}2", "Hand{0}3", "Hand{0}4", "Hand{0}4_end"],
    "two joints": ["{0}1", "{0}2", "{0}2_end"],
    "metacarpal and two joints": ["{0}_metacarpal", "{0}1", "{0}2"],
}  # fmt: skip


@pytest.mark.parametrize("style", HAND_BONES)
def test_ends_helpers_and_metacarpals_are_left_out(style):
    names, parents, positions = ["hand_l", "hand_l_twist"], [-1, 0], [[0.0, 0.0, 0.0], [0.02, 0.0, 0.0]]
    for k, finger in enumerate(FINGERS[1:], 1):
        above, is_long = 0, "inHand" in HAND_BONES[style][0] or HAND_BONES[style][0].startswith(("In", "palm", "{0}_meta"))
        for n, pattern in enumerate(HAND_BONES[style]):
            names.append("l_" + pattern.format(finger.title(), k))
            parents.append(above)
            positions.append([0.02 + 0.07 * (n > 0) + 0.03 * n if is_long else 0.09 + 0.03 * n, 0.0, 0.02 * k])
            above = len(names) - 1
        if style == "Unreal":  # as MetaHuman's
            names += [f"{finger}_03_half_l", f"{finger}_01_mcp_l"]
            parents += [above, above - 2]
            positions += [positions[above], positions[above - 2]]
    found = find_fingers(names, np.array(parents), np.array(positions), {"left_hand": (0,)})
    assert set(found) == {f"left_{finger}" for finger in FINGERS[1:]}
    for chain in found.values():
        assert len(chain) == (2 if "two" in style else 3)
        assert not any(names[bone].endswith(("_end", "_tip", "half_l", "y4", "x4", "e4", "g4", "metacarpal")) for bone in chain)
        assert [parents[bone] for bone in chain[1:]] == list(chain[:-1])


@pytest.mark.parametrize("missing", [None, "ring"])
@pytest.mark.parametrize("joints", [2, 3])
def test_fingers_without_known_names_are_found_by_the_shape_of_the_hand(joints, missing):
    rng, kept = np.random.default_rng(3), [finger for finger in FINGERS if finger != missing]
    numbers = dict(zip(kept, rng.permutation(len(kept)).tolist(), strict=True))
    named = add_hands(load_character("smpl"), joints, seed=4, fingers=kept)
    bare = [
        f"bone{side}{numbers[finger]}{name[-1]}" if (finger := name.partition("_")[2][:-1]) in kept else name
        for name in named.skeleton.names
        for side in [name.partition("_")[0]]
    ]
    found = find_fingers(bare, named.skeleton.parents, named.skeleton.rest_positions, named.mapping.bones)
    assert found == named.mapping.fingers


def test_a_hand_with_one_end_or_a_prop_has_no_fingers():
    smpl = load_character("smpl")
    assert smpl.mapping.fingers == {}
    names, parents = [*smpl.skeleton.names, "sword", "blade"], np.append(smpl.skeleton.parents, [20, len(smpl.skeleton.names)])
    positions = np.concatenate([smpl.skeleton.rest_positions, np.ones((2, 3))])
    assert find_fingers(names, parents, positions, smpl.mapping.bones) == {}


@pytest.mark.parametrize("metacarpals", [False, True])
@pytest.mark.parametrize("joints", [2, 3])
def test_bones_of_other_axes_and_rest_poses_point_as_those_of_the_hand(walk, joints, metacarpals):
    source, motion, hands = walk
    target = add_hands(load_character("smpl"), joints, metacarpals, seed=7)
    posed = retarget_motion(source, motion, target, hands=hands)
    for side, hand in hands.items():
        palm = hand.palm  # the target's hand is within its orientation's deviation of it
        for finger, poses in hand.fingers.items():
            straight, lengths = compute_straight_finger(side, finger)
            wanted = (palm[:, None] @ poses) @ straight
            if joints == 2:
                chord = (wanted[:, 1:] * lengths[1:, None]).sum(1)
                chord = (wanted[:, :2] * lengths[:2, None]).sum(1) if finger == "thumb" else chord
                chord = chord / np.linalg.norm(chord, axis=1, keepdims=True)
                wanted = np.stack([chord, wanted[:, 2]] if finger == "thumb" else [wanted[:, 0], chord], axis=1)
            found = measure_directions(target, posed, side, finger)
            assert compute_angles_deg(found, wanted).max() < CLOSE_DEG


def test_one_bent_finger_bends_alone(walk):
    source, motion, _ = walk
    target, count = add_hands(load_character("smpl"), seed=2), motion.frame_count
    flexed = compose_hands(count)
    model, bent = load_hand("Left"), Rotation.from_rotvec(load_hand("Left").compute_angles(np.array([0, 0, 1.0]))).as_matrix()
    axes = model.skeleton.rest_rotations[RAY_ROOTS[3]]
    straight = {name: np.tile(np.eye(3), (count, 3, 1, 1)) for name in FINGERS}
    ring = np.tile(axes @ bent @ axes.T, (count, 3, 1, 1))
    hands = {"left": flexed["left"]._replace(fingers=straight | {"ring": ring})}
    posed = retarget_motion(source, motion, target, hands=hands)
    for finger in FINGERS:
        along, _ = compute_straight_finger("left", finger)
        turn = compute_angles_deg(measure_directions(target, posed, "left", finger), hands["left"].palm[:, None] @ along)
        np.testing.assert_allclose(turn, 57.3 if finger == "ring" else 0.0, atol=CLOSE_DEG)
    down = measure_directions(target, posed, "left", "ring")[:, 0] - measure_directions(target, posed, "left", "middle")[:, 0]
    assert (np.einsum("tab,ta->tb", hands["left"].palm, down)[:, 1] < -0.5).all()  # to the palm, not to the back of the hand


def test_a_finger_that_the_source_lacks_bends_like_its_neighbour(walk):
    source, motion, hands = walk
    target = add_hands(load_character("smpl"), seed=2)
    few = {
        side: hand._replace(fingers={k: v for k, v in hand.fingers.items() if k in ("index", "pinky")})
        for side, hand in hands.items()
    }
    posed = retarget_motion(source, motion, target, hands=few)
    whole = retarget_motion(source, motion, target, hands=hands)
    for name, chain in target.mapping.fingers.items():
        kept = posed.local_rotations[:, list(chain)]
        if name.endswith("thumb"):
            np.testing.assert_allclose(kept, np.broadcast_to(target.skeleton.rest_rotations[list(chain)], kept.shape), atol=1e-9)
        elif name.endswith(("index", "pinky")):
            np.testing.assert_allclose(kept, whole.local_rotations[:, list(chain)], atol=1e-9)
    straight, _ = compute_straight_finger("left", "middle")
    bend = compute_angles_deg(measure_directions(target, posed, "left", "middle"), few["left"].palm[:, None] @ straight)
    index, _ = compute_straight_finger("left", "index")
    like = compute_angles_deg(measure_directions(target, posed, "left", "index"), few["left"].palm[:, None] @ index)
    np.testing.assert_allclose(bend, like, atol=8.0)  # the axis of the turn is not across both fingers


def test_the_report_counts_the_fingers_that_follow(tmp_path):
    skeleton, motion, hands = compose_hands_on_body()
    poses = {hand.hand.model.side.lower(): convert_hand_motion(hand, RATE_HZ, RATE_HZ) for hand in hands}
    poses["left"] = poses["left"]._replace(fingers={"index": poses["left"].fingers["index"]})  # no thumb
    moved = motion.select_frames(np.arange(4))
    few = {
        side: hand._replace(palm=hand.palm[:4], fingers={k: v[:4] for k, v in hand.fingers.items()})
        for side, hand in poses.items()
    }
    for name, count in (("mixamo", 4), ("smpl", 0)):
        notes = CharacterFiles(load_character(name), OutputOptions()).write(
            tmp_path / f"a.{name}.glb", skeleton, moved, RATE_HZ, hands=few
        )
        expected = f"follow those of the take: {count} of the left hand, {count + (count > 0)} of the right hand."
        assert any(expected in note for note in notes)


def test_hands_do_not_change_a_character_without_fingers_and_none_keep_the_rest_pose(walk):
    source, motion, hands = walk
    bare = load_character("smpl")
    with_hands, without = (retarget_motion(source, motion, bare, hands=each) for each in (hands, {}))
    assert (with_hands.local_rotations == without.local_rotations).all()
    mixamo = load_character("mixamo")
    chain = [bone for bones in mixamo.mapping.fingers.values() for bone in bones]
    posed = retarget_motion(source, motion, mixamo)
    assert (posed.local_rotations[:, chain] == mixamo.skeleton.rest_rotations[chain]).all()
    left = retarget_motion(source, motion, mixamo, hands={"left": hands["left"]})
    right = [bone for name, bones in mixamo.mapping.fingers.items() if name.startswith("right") for bone in bones]
    assert (left.local_rotations[:, right] == mixamo.skeleton.rest_rotations[right]).all()


@pytest.mark.parametrize(("name", "other"), [("mixamo", "unreal"), ("unreal", "vrm"), ("rigify", "daz-g9")])
def test_fingers_go_from_one_character_to_another(walk, name, other):
    source, motion, hands = walk
    first, second = load_character(name), load_character(other)
    posed = retarget_motion(source, motion, first, hands=hands)
    moved = retarget_motion(first, posed, second)
    for side in SIDES:
        palms = [measure_hand_poses(c, *compute_character_poses(c, m))[side].palm for c, m in ((first, posed), (second, moved))]
        for finger in FINGERS:
            directions = [
                np.einsum("tab,tka->tkb", palm, measure_directions(c, m, side, finger))[:, :2]  # tips of presets may be missing
                for palm, (c, m) in zip(palms, ((first, posed), (second, moved)), strict=True)
            ]
            assert compute_angles_deg(*directions).max() < CLOSE_DEG


@pytest.mark.parametrize("name", ["mixamo", "unreal"])
def test_fingers_of_a_bvh_are_those_that_were_written(walk, tmp_path, name):
    source, motion, hands = walk
    character = load_character(name)
    write_character_bvh(tmp_path / "hero.bvh", character, retarget_motion(source, motion, character, hands=hands))
    animation = read_bvh(tmp_path / "hero.bvh", options=ReadOptions(unit="cm", up_axis="Y"))
    found, notes = measure_animation_hands(animation, motion.rate)
    assert notes == []
    for side in SIDES:
        for finger, poses in hands[side].fingers.items():
            straight, _ = compute_straight_finger(side, finger)
            read = found[side].palm[:, None] @ found[side].fingers[finger] @ straight
            assert compute_angles_deg(read, hands[side].palm[:, None] @ poses @ straight).max() < CLOSE_DEG
    half, _ = measure_animation_hands(animation, motion.rate / 2)
    np.testing.assert_allclose(half["left"].palm, found["left"].palm[::2], atol=1e-9)


def test_a_file_that_changed_since_it_was_read_gives_no_fingers_and_a_note(walk, tmp_path):
    source, motion, hands = walk
    character, path = load_character("mixamo"), tmp_path / "hero.bvh"
    write_character_bvh(path, character, retarget_motion(source, motion, character, hands=hands))
    animation = read_bvh(path, options=ReadOptions(unit="cm", up_axis="Y"))
    path.write_text(path.read_text(encoding="utf-8").replace("LeftHandRing2", "LeftHandRingTwo"), encoding="utf-8")
    found, [note] = measure_animation_hands(animation, motion.rate)
    assert found == {}
    assert "changed since it was read" in note


@pytest.mark.parametrize(("names", "has_fingers"), [
    (["Hips", "LeftHandIndex1", "LeftHandIndex2"], True),
    (["hip", "lMid1", "lMid2"], True),
    (["root", "lefthandthumb1", "lefthandthumb2"], True),
    (["root", "l_indexmetacarpal", "l_index1"], True),
    (["Hips", "MidSpine", "MidChest"], False),
    (["Hips", "Spring1", "Spring2"], False),
    (["Ringleader", "Ringleader_Spine", "Pyramid"], False),
    (["hip", "lSmallToe1", "lSmallToe2"], False),
])  # fmt: skip
def test_only_whole_words_name_fingers(names, has_fingers):
    assert has_named_fingers(names, np.arange(-1, len(names) - 1)) == has_fingers


def test_fingers_of_a_bvh_of_a_body_point_as_the_solved_ones(tmp_path):
    skeleton, motion, hands = compose_hands_on_body()
    positions, moved = compute_world_poses(skeleton, motion)[0], []
    for hand in hands:
        wrist = positions[:, skeleton.find_joint(f"{hand.hand.model.side}FingerBase")]
        points = hand.point_positions + (wrist - hand.palm_position)[:, None]
        moved.append(replace(hand, palm_position=wrist, point_positions=points))
    hands = tuple(moved)
    write_bvh_tree(tmp_path / "body.bvh", *attach_hands(skeleton, motion, RATE_HZ, hands, RATE_HZ), RATE_HZ)
    found, notes = measure_animation_hands(read_bvh(tmp_path / "body.bvh", options=ReadOptions(unit="cm", up_axis="Y")), RATE_HZ)
    assert notes == []
    for hand in hands:
        side, points = hand.hand.model.side.lower(), hand.point_positions
        np.testing.assert_allclose(found[side].position, hand.palm_position, atol=1e-6)
        for ray, finger in enumerate(FINGERS):
            straight, lengths = compute_straight_finger(side, finger)
            directions = found[side].palm[:, None] @ found[side].fingers[finger] @ straight
            solved = np.diff(np.stack([*points[:, 3 * ray : 3 * ray + 3].swapaxes(0, 1), points[:, 15 + ray]], axis=1), axis=1)
            assert compute_angles_deg(directions, solved).max() < 0.01
            np.testing.assert_allclose(np.linalg.norm(found[side].offsets[finger][1:], axis=1), lengths[:2], atol=1e-6)
    none = {segment: bones for segment, bones in load_character("mixamo").mapping.bones.items() if "hand" not in segment}
    mixamo = load_character("mixamo").skeleton
    assert find_palms(mixamo.names, mixamo.parents, none) == load_character("mixamo").mapping.bones
    few = [name if "Thumb" in name or "Index" in name else f"bone{k}" for k, name in enumerate(mixamo.names)]
    assert find_palms(few, mixamo.parents, none) == none


def test_fingers_that_never_move_are_no_motion():
    character = load_character("mixamo")
    position, rotation = character.skeleton.compute_rest_pose()
    assert measure_hand_poses(character, np.tile(position, (5, 1, 1)), np.tile(rotation, (5, 1, 1, 1))) == {}


def test_a_mapping_file_gives_the_fingers(tmp_path):
    path, character = tmp_path / "hero.map.yaml", load_character("mixamo")
    write_mapping_file(path, character)
    assert read_mapping_file(path, character).fingers == character.mapping.fingers
    text = path.read_text(encoding="utf-8")
    names = [f"'mixamorig:LeftHandIndex{k}'" for k in (1, 2, 3)]
    path.write_text(text.replace(f"left_index: [{', '.join(names)}]", "left_index: []"), encoding="utf-8")
    edited = load_character("mixamo", path).mapping.fingers
    assert set(character.mapping.fingers) - set(edited) == {"left_index"}
    path.write_text(text[: text.index("fingers:\n")], encoding="utf-8")  # as files of earlier versions
    assert load_character("mixamo", path).mapping.fingers == character.mapping.fingers
    path.write_text(text.replace("left_index: [", "left_sixth: ["), encoding="utf-8")
    with pytest.raises(SceneError, match="left_sixth: must have two or three bones and be one of left_thumb"):
        load_character("mixamo", path)
    path.write_text(text.replace(f"[{', '.join(names)}]", f"[{', '.join(names[::-1])}]"), encoding="utf-8")
    with pytest.raises(SceneError, match="left_index: the bone 'mixamorig:LeftHandIndex2' is not below"):
        load_character("mixamo", path)
    write_mapping_file(path, load_character("smpl"))
    assert "left_index" not in path.read_text(encoding="utf-8")
