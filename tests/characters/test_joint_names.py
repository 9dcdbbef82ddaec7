from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.bone_mapping import (
    NameTable,
    load_naming_convention,
    load_shipped_conventions,
    map_joints,
    map_joints_by_shape,
)
from mocapfix.errors import SceneError
from mocapfix.io.shipped import read_shipped_yaml
from mocapfix.model.skeleton import find_ancestor, is_below, load_cmu31_body

MODEL = load_cmu31_body().skeleton


def build_named_tree(convention: NameTable) -> tuple[list[str], np.ndarray]:
    """Return names and parents of a body with a convention's names: for each joint the most likely one that is free."""
    names: dict[int, str] = {}
    for joint, candidates in read_shipped_yaml(f"hierarchies/{convention.name}.yaml")["joints"].items():
        free = [name for name in candidates if name not in names.values()]
        if free:
            names[MODEL.find_joint(joint)] = free[0]
    joints = sorted(names)
    is_named = np.isin(np.arange(31), joints)
    above = [find_ancestor(joint, MODEL.parents, is_named) for joint in joints]
    return [names[joint] for joint in joints], np.array([joints.index(joint) if joint >= 0 else -1 for joint in above])


def map_names(names, parents: Sequence[int], convention: str | Path | None = None) -> dict[str, str]:
    """Return the names of a file's joints by model joint."""
    mapping = map_joints(names, np.asarray(parents), convention)
    assert mapping.file_joints is not None, mapping.reason
    return {model: names[joint] for model, joint in zip(MODEL.names, mapping.file_joints.tolist(), strict=True) if joint >= 0}


@pytest.mark.parametrize("convention", load_shipped_conventions(), ids=lambda convention: convention.name)
def test_no_convention_matches_more_joints_of_a_body_than_its_own(convention: NameTable):
    names, parents = build_named_tree(convention)
    mapping = map_joints(names, parents)
    assert mapping.file_joints is not None, mapping.reason
    assert (mapping.file_joints >= 0).sum() == len(names)
    assert len(names) >= 17
    np.testing.assert_array_equal(mapping.file_joints, map_joints(names, parents, convention.name).file_joints)


# fmt: off
MIXAMO_NAMES = [
    "Hips", "Spine", "Spine1", "Spine2", "Neck", "Head", "HeadTop_End", "LeftShoulder",
    "LeftArm", "LeftForeArm", "LeftHand", "LeftHandThumb1", "LeftHandThumb2", "LeftHandIndex1", "RightShoulder", "RightArm",
    "RightForeArm", "RightHand", "LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase", "LeftToe_End", "RightUpLeg",
    "RightLeg", "RightFoot", "RightToeBase",
]
# fmt: on
MIXAMO_PARENTS = [-1, 0, 1, 2, 3, 4, 5, 3, 7, 8, 9, 10, 11, 10, 3, 14, 15, 16, 0, 18, 19, 20, 21, 0, 23, 24, 25]


@pytest.mark.parametrize("pattern", ["{}", "mixamorig:{}", "mixamorig_{}", "Jim:mixamorig{}", "|Armature|{}"])
def test_common_prefix_is_ignored(pattern: str):
    names = [pattern.format(name) for name in MIXAMO_NAMES]
    prefix = pattern.partition("{")[0]
    joints = {model: name.removeprefix(prefix) for model, name in map_names(names, MIXAMO_PARENTS).items()}
    assert joints["Spine1"] == "Spine2"
    assert joints["LowerBack"] == "Spine"
    assert joints["Spine"] == "Spine1"
    assert joints["LThumb"] == "LeftHandThumb1"
    assert all(joints[name] == name for name in ("Hips", "Head", "LeftUpLeg", "RightHand"))
    assert "Neck1" not in joints


def test_case_and_punctuation_are_ignored():
    names = [name.upper().replace("LEFT", "left_").replace("RIGHT", "Right ") for name in MIXAMO_NAMES]
    assert set(map_names(names, MIXAMO_PARENTS)) == set(map_names(MIXAMO_NAMES, MIXAMO_PARENTS))


def test_root_of_biped_is_named_by_prefix_alone():
    names = ["Bip01", "Bip01 Pelvis", "Bip01 Spine", "Bip01 Spine1", "Bip01 Neck", "Bip01 Head"]
    parents = [-1, 0, 1, 2, 3, 4]
    for side in "LR":
        first = len(names)
        names += [f"Bip01 {side} {bone}" for bone in ("Thigh", "Calf", "Foot", "Clavicle", "UpperArm", "Forearm", "Hand")]
        parents += [1, first, first + 1, 3, first + 3, first + 4, first + 5]
    joints = map_names(names, parents)
    assert joints["Hips"] == "Bip01 Pelvis"
    assert (joints["LowerBack"], joints["Spine1"]) == ("Bip01 Spine", "Bip01 Spine1")
    assert joints["RightForeArm"] == "Bip01 R Forearm"


def test_joint_below_another_limb_is_discarded():
    parents = MIXAMO_PARENTS.copy()
    parents[MIXAMO_NAMES.index("LeftToeBase")] = MIXAMO_NAMES.index("RightFoot")
    assert "LeftToeBase" not in map_names(MIXAMO_NAMES, parents)
    assert "LeftToeBase" in map_names(MIXAMO_NAMES, MIXAMO_PARENTS)


def test_body_without_a_limb_is_not_mapped():
    names = [name.replace("RightForeArm", "Prop") for name in MIXAMO_NAMES]
    mapping = map_joints(names, np.array(MIXAMO_PARENTS))
    assert mapping.file_joints is None
    assert "MotionBuilder" in mapping.reason
    assert "lacks RightForeArm" in mapping.reason
    unknown = map_joints(["a", "b"], np.array([-1, 0]))
    assert unknown.file_joints is None
    assert "no joint name is known" in unknown.reason


@pytest.mark.parametrize("letter", ["j{}", "\u9aa8{}", None], ids=["latin", "digits", "other letters"])
def test_convention_from_file(tmp_path, letter: str | None):
    names = [letter.format(index) if letter else chr(0x4E00 + index) for index in range(len(MIXAMO_NAMES))]
    name_by_model = {model: names[MIXAMO_NAMES.index(name)] for model, name in map_names(MIXAMO_NAMES, MIXAMO_PARENTS).items()}
    lines = ["name: mine", "title: My own", "joints:", *(f"  {model}: [{name}]" for model, name in name_by_model.items())]
    (tmp_path / "mine.yaml").write_text("\n".join(lines), encoding="utf-8")
    assert map_names(names, MIXAMO_PARENTS, tmp_path / "mine.yaml") == name_by_model
    mapping = map_joints(names, np.array(MIXAMO_PARENTS), tmp_path / "mine.yaml")
    assert mapping.reason == f"My own: found {len(name_by_model)} of the 31 joints."
    assert map_joints(MIXAMO_NAMES, np.array(MIXAMO_PARENTS), "cmu").reason.startswith("CMU")


def test_unknown_or_invalid_convention_is_refused(tmp_path):
    with pytest.raises(SceneError, match=r"naming convention.*acclaim, biped"):
        load_naming_convention("mayan")
    (tmp_path / "a.yaml").write_text("name: a\ntitle: A\njoints: {Hips: [a], Tail: [b]}", encoding="utf-8")
    with pytest.raises(SceneError, match=r"a\.yaml: joints\.Tail.*no joint 'Tail'"):
        load_naming_convention(tmp_path / "a.yaml")
    (tmp_path / "a.yaml").write_text("name: a\ntitle: A\njoints: {Hips: a}", encoding="utf-8")
    with pytest.raises(SceneError, match=r"a\.yaml: joints\.Hips"):
        load_naming_convention(Path(tmp_path / "a.yaml"))


BODY = [joint for joint, name in enumerate(MODEL.names) if not name.endswith(("FingerBase", "HandIndex1", "Thumb"))]
BODY_NAMES = [MODEL.names[joint] for joint in BODY]
BODY_PARENTS = np.array([BODY.index(parent) if parent >= 0 else -1 for parent in MODEL.parents[BODY].tolist()])


def pose_body(bend_rad: float) -> np.ndarray:
    """Return the places of a standing body's joints without fingers; its left elbow is bent."""
    positions, elbow = MODEL.rest_positions.copy(), MODEL.find_joint("LeftForeArm")
    below = [joint for joint in BODY if is_below(joint, elbow, MODEL.parents)]
    turn = Rotation.from_euler("z", bend_rad).as_matrix()
    positions[below] = positions[elbow] + (positions[below] - positions[elbow]) @ turn.T
    return positions[BODY]


@pytest.mark.parametrize("heading_rad", [0.0, 2.0])
def test_unknown_names_are_mapped_by_the_shape_in_the_pose_that_shows_most(heading_rad: float):
    turn = Rotation.from_euler("y", heading_rad).as_matrix()
    poses = [pose_body(bend) @ turn.T for bend in (1.0, 0.0)]
    mapping = map_joints_by_shape([f"bone_{joint}" for joint in range(len(BODY))], BODY_PARENTS, poses)
    assert mapping is not None
    assert mapping.file_joints is not None
    found = {name: BODY_NAMES[joint] for name, joint in zip(MODEL.names, mapping.file_joints, strict=True) if joint >= 0}
    assert all(name == own for name, own in found.items())
    assert {side + bone for side in ("Left", "Right") for bone in ("Shoulder", "Hand", "ToeBase")} <= set(found)
    assert {"Hips", "Spine1", "Head"} <= set(found)


def test_one_unknown_name_is_mapped_by_the_shape_and_the_others_by_their_names():
    names = [name.replace("LeftArm", "Linker_Arm") for name in BODY_NAMES]
    assert map_joints(names, BODY_PARENTS).file_joints is None
    mapping = map_joints_by_shape(names, BODY_PARENTS, [pose_body(0.0)])
    assert mapping is not None
    assert mapping.file_joints is not None
    np.testing.assert_array_equal(mapping.file_joints[BODY], np.arange(len(BODY)))


def test_tree_that_is_no_body_is_not_mapped_by_its_shape():
    assert map_joints_by_shape(["a", "b", "c"], np.array([-1, 0, 1]), [np.eye(3)]) is None


def build_soma_tree() -> tuple[list[str], list[int]]:
    """Return names and parents of NVIDIA's skeleton of 77 joints below Root."""
    chains = ["Root Hips Spine1 Spine2 Chest Neck1 Neck2 Head HeadEnd", "Head Jaw", "Head LeftEye", "Head RightEye"]
    for side in ("Left", "Right"):
        chains.append(f"Hips {side}Leg {side}Shin {side}Foot {side}ToeBase {side}ToeEnd")
        chains.append(f"Chest {side}Shoulder {side}Arm {side}ForeArm {side}Hand")
        for finger, count in {"Thumb": 3, "Index": 4, "Middle": 4, "Ring": 4, "Pinky": 4}.items():
            chains.append(" ".join([f"{side}Hand", *(f"{side}Hand{finger}{each}" for each in [*range(1, count + 1), "End"])]))
    names, parents = ["Root"], [-1]
    for chain in chains:
        above, *below = chain.split()
        for name in below:
            names.append(name)
            parents.append(names.index(above))
            above = name
    return names, parents


def test_the_thigh_of_soma_is_its_left_leg():
    names, parents = build_soma_tree()
    assert len(names) == 78
    found = map_names(names, parents)
    assert len(found) == 27
    assert [found[joint] for joint in ("Hips", "LeftUpLeg", "LeftLeg", "LeftFoot", "Spine1", "Neck1", "RightHandIndex1")] == [
        "Hips", "LeftLeg", "LeftShin", "LeftFoot", "Chest", "Neck2", "RightHandIndex2",
    ]  # fmt: skip


def test_names_of_phc_are_those_of_smpl():
    chains = (
        ["Pelvis", "Torso", "Spine", "Chest", "Neck", "Head"],
        *(
            each.replace("S_", f"{side}_").split()
            for side in "LR"
            for each in ("Pelvis S_Hip S_Knee S_Ankle S_Toe", "Chest S_Thorax S_Shoulder S_Elbow S_Wrist S_Hand")
        ),
    )
    names, parents = ["Pelvis"], [-1]
    for above, *below in chains:
        for name in below:
            names.append(name)
            parents.append(names.index(above))
            above = name
    found = map_names(names, parents)
    assert len(found) == 22
    assert [found[joint] for joint in ("LowerBack", "Spine", "Spine1", "LeftShoulder", "LeftArm", "RightToeBase")] == [
        "Torso", "Spine", "Chest", "L_Thorax", "L_Shoulder", "R_Toe",
    ]  # fmt: skip
