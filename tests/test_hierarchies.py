from pathlib import Path

import numpy as np
import pytest

from mocapfix.animations import joint_mapping
from mocapfix.errors import SceneError
from mocapfix.skeleton import load_cmu31_body

OURS = load_cmu31_body().skeleton


def tree(style: joint_mapping.NamingConvention) -> tuple[list[str], np.ndarray]:
    """-> names and parents of a body that a style knows, each joint by the likeliest of its names that is free."""
    names: dict[int, str] = {}
    for joint, likely in style.candidate_names.items():
        free = [name for name in likely if name not in names.values()]
        if free:
            names[OURS.find_joint(joint)] = free[0]
    kept = sorted(names)
    among = np.isin(np.arange(31), kept)
    above = [joint_mapping.find_ancestor(joint, OURS.parents, among) for joint in kept]
    return [names[joint] for joint in kept], np.array([kept.index(joint) if joint >= 0 else -1 for joint in above])


def found(names, parents) -> dict[str, str]:
    choice = joint_mapping.map_joints(names, np.asarray(parents))
    assert choice.mapping is not None, choice.reason
    return choice.mapping.names(names)


@pytest.mark.parametrize("style", joint_mapping.load_shipped_conventions(), ids=lambda style: style.name)
def test_every_style_knows_a_body_of_its_own_and_no_other_knows_more_of_it(style):
    names, parents = tree(style)
    choice = joint_mapping.map_joints(names, parents)
    assert choice.mapping is not None, choice.reason
    assert (choice.mapping.file_joints >= 0).sum() == len(names)
    assert len(names) >= 17
    np.testing.assert_array_equal(choice.mapping.file_joints, style.joints(names, parents))


SPELLED = """Hips Spine Spine1 Spine2 Neck Head HeadTop_End LeftShoulder LeftArm LeftForeArm LeftHand LeftHandThumb1
LeftHandThumb2 LeftHandIndex1 RightShoulder RightArm RightForeArm RightHand LeftUpLeg LeftLeg LeftFoot LeftToeBase LeftToe_End
RightUpLeg RightLeg RightFoot RightToeBase"""
MIXAMO: list[str] = [*SPELLED.split()]
ABOVE = [-1, 0, 1, 2, 3, 4, 5, 3, 7, 8, 9, 10, 11, 10, 3, 14, 15, 16, 0, 18, 19, 20, 21, 0, 23, 24, 25]


@pytest.mark.parametrize("spelled", ["{}", "mixamorig:{}", "mixamorig_{}", "Jim:mixamorig{}", "|Armature|{}"])
def test_what_stands_before_all_names_does_not_count(spelled):
    names = [spelled.format(name) for name in MIXAMO]
    joints = {ours: theirs.removeprefix(spelled.partition("{")[0]) for ours, theirs in found(names, ABOVE).items()}
    assert joints["Spine1"] == "Spine2"
    assert joints["LowerBack"] == "Spine"
    assert joints["Spine"] == "Spine1"
    assert joints["LThumb"] == "LeftHandThumb1"
    assert {ours: joints[ours] for ours in ("Hips", "Head", "LeftUpLeg", "RightHand")} == {
        ours: ours for ours in ("Hips", "Head", "LeftUpLeg", "RightHand")
    }
    assert "Neck1" not in joints


def test_case_and_signs_do_not_count():
    names = [name.upper().replace("LEFT", "left_").replace("RIGHT", "Right ") for name in MIXAMO]
    assert set(found(names, ABOVE)) == set(found(MIXAMO, ABOVE))


def test_the_prefix_of_a_biped_may_be_its_root():
    names = ["Bip01", "Bip01 Pelvis", "Bip01 Spine", "Bip01 Spine1", "Bip01 Neck", "Bip01 Head"]
    parents = [-1, 0, 1, 2, 3, 4]
    for side in "LR":
        at = len(names)
        names += [f"Bip01 {side} {bone}" for bone in ("Thigh", "Calf", "Foot", "Clavicle", "UpperArm", "Forearm", "Hand")]
        parents += [1, at, at + 1, 3, at + 3, at + 4, at + 5]
    joints = found(names, parents)
    assert joints["Hips"] == "Bip01 Pelvis"
    assert (joints["LowerBack"], joints["Spine1"]) == ("Bip01 Spine", "Bip01 Spine1")
    assert joints["RightForeArm"] == "Bip01 R Forearm"


def test_a_joint_that_hangs_elsewhere_is_not_taken():
    parents = ABOVE.copy()
    parents[MIXAMO.index("LeftToeBase")] = MIXAMO.index("RightFoot")
    assert "LeftToeBase" not in found(MIXAMO, parents)
    assert "LeftToeBase" in found(MIXAMO, ABOVE)


def test_a_body_that_lacks_a_limb_is_not_mapped_and_it_is_said():
    names = [name.replace("RightForeArm", "Prop") for name in MIXAMO]
    choice = joint_mapping.map_joints(names, np.array(ABOVE))
    assert choice.mapping is None
    assert "MotionBuilder" in choice.reason
    assert "which lacks RightForeArm" in choice.reason
    nothing = joint_mapping.map_joints(["a", "b"], np.array([-1, 0]))
    assert nothing.mapping is None
    assert "none is known" in nothing.reason


def test_a_style_may_be_given(tmp_path):
    names = [f"j{at}" for at in range(len(MIXAMO))]
    spelled = {ours: names[MIXAMO.index(theirs)] for ours, theirs in found(MIXAMO, ABOVE).items()}
    lines = ["name: mine", "title: My own", "joints:", *(f"  {ours}: [{theirs}]" for ours, theirs in spelled.items())]
    (tmp_path / "mine.yaml").write_text("\n".join(lines))
    choice = joint_mapping.map_joints(names, np.array(ABOVE), tmp_path / "mine.yaml")
    assert choice.mapping is not None
    assert choice.mapping.names(names) == spelled
    assert choice.reason == f"My own: {len(spelled)} of the 31 joints were found."
    assert joint_mapping.map_joints(MIXAMO, np.array(ABOVE), "cmu").reason.startswith("CMU")


def test_a_style_that_is_not_as_it_should_be_is_refused(tmp_path):
    with pytest.raises(SceneError, match="no such style of names; name one of acclaim, biped"):
        joint_mapping.load_naming_convention("mayan")
    (tmp_path / "a.yaml").write_text("name: a\ntitle: A\njoints: {Hips: [a], Tail: [b]}")
    with pytest.raises(SceneError, match=r"a\.yaml: joints\.Tail.*there is no joint 'Tail'"):
        joint_mapping.load_naming_convention(tmp_path / "a.yaml")
    (tmp_path / "a.yaml").write_text("name: a\ntitle: A\njoints: {Hips: a}")
    with pytest.raises(SceneError, match=r"a\.yaml: joints\.Hips"):
        joint_mapping.load_naming_convention(Path(tmp_path / "a.yaml"))
