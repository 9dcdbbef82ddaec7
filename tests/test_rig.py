import pytest

from mocapfix.errors import SceneError
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.options import RIG_NAMES
from mocapfix.skeleton import load_cmu31_body
from mocapfix.write import rig

# HumanIK's slots that MotionBuilder maps by name, and the joints that Character Studio's specification of BVH names.
HUMAN_IK = {"Hips", "Spine", "Spine1", "Spine2", "Neck", "Neck1", "Head"} | {
    f"{side}{name}"
    for side in ("Left", "Right")
    for name in ("UpLeg", "Leg", "Foot", "ToeBase", "Shoulder", "Arm", "ForeArm", "Hand")
}
BIPED = {"Hips": None, "Chest": "Hips", "Chest2": "Chest", "Chest3": "Chest2", "Neck": "Chest3", "Head": "Neck"}
for side in ("Left", "Right"):
    BIPED |= {f"{side}Hip": "Hips", f"{side}Knee": f"{side}Hip", f"{side}Ankle": f"{side}Knee", f"{side}Toe": f"{side}Ankle"}
    BIPED |= {f"{side}Collar": "Chest3", f"{side}Shoulder": f"{side}Collar"}
    BIPED |= {f"{side}Elbow": f"{side}Shoulder", f"{side}Wrist": f"{side}Elbow"}


def test_every_rig_that_ships_is_named_where_the_command_line_looks():
    there = {path.stem for path in (find_shipped_folder("scenes") / "rigs").glob("*.yaml")}
    assert there == {*RIG_NAMES, "poses"}


@pytest.mark.parametrize("name", RIG_NAMES)
def test_a_rig_stands_for_joints_that_the_skeleton_has(name):
    known = set(load_cmu31_body().skeleton.names)
    assert all({joint.joint, joint.axes, joint.end} <= known for joint in rig.load_rig(name).joints)


def test_motionbuilder_s_names_are_those_it_maps_by_itself():
    told = rig.load_rig("motionbuilder")
    assert {joint.name for joint in told.joints} == HUMAN_IK
    assert (told.rest_pose, told.starts_with_t_pose) == ("t-pose", True)


def test_biped_s_names_and_parents_are_those_of_its_specification_and_its_arms_hang():
    told = rig.load_rig("3dsmax")
    assert {joint.name: joint.parent for joint in told.joints} == BIPED
    assert (told.rest_pose, told.starts_with_t_pose) == ("arms-down", False)


def test_cmu_s_are_the_skeleton_s_own_names_in_its_own_order():
    assert tuple(joint.name for joint in rig.load_rig("cmu").joints) == load_cmu31_body().skeleton.names
    assert rig.load_rig("cmu").unit_m == pytest.approx(0.0254 / 0.45)


def test_every_name_of_blender_s_has_its_mirror_image():
    names = {joint.name for joint in rig.load_rig("blender").joints}
    sides = {name for name in names if name.startswith(("Left", "Right"))}
    assert {name.replace("Left", "?").replace("Right", "Left").replace("?", "Right") for name in sides} == sides
    assert names - sides == {"Hips", "LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head"}


def test_a_name_that_is_no_rig_is_answered_with_those_there_are():
    with pytest.raises(SceneError, match=r"no rig 'maya'; choose of: 3dsmax, blender, cmu, motionbuilder; or give a \.yaml"):
        rig.load_rig("maya")
    with pytest.raises(SceneError, match="no rig 'poses'"):
        rig.load_rig("poses")


MINE = """
program: Mine
unit_m: 0.0254
rotations: XYZ
rest: skeleton
first_frame: motion
note: nothing
joints:
  - {name: Pelvis, parent: null, joint: Hips}
  - {name: Trunk, parent: Pelvis, joint: LowerBack, end: Head}
"""


@pytest.mark.parametrize(
    ("what", "instead", "said"),
    [
        ("parent: Pelvis", "parent: Hips", "Trunk: must come once, after its parent"),
        ("name: Trunk", "name: Pelvis", "Pelvis: must come once"),
        ("parent: Pelvis", "parent: null", "Trunk: must come once, after its parent; the first alone is the root"),
        ("name: Trunk", "name: my trunk", r"joints\.1\.name"),
        ("rotations: XYZ", "rotations: XYX", "rotations"),
        ("unit_m: 0.0254", "unit_m: 0", "unit_m"),
        ("program: Mine", "programme: Mine", "program"),
    ],
)
def test_a_rig_of_one_s_own_is_read_and_a_fault_in_it_is_named(tmp_path, what, instead, said):
    path = tmp_path / "mine.yaml"
    path.write_text(MINE)
    mine = rig.load_rig(path)
    assert (mine.name, mine.unit_m, mine.parents) == ("mine", 0.0254, [-1, 0])
    assert (mine.joints[1].joint, mine.joints[1].axes, mine.joints[1].end) == ("LowerBack", "LowerBack", "Head")
    path.write_text(MINE.replace(what, instead))
    with pytest.raises(SceneError, match=rf"mine\.yaml.*{said}"):
        rig.load_rig(path)
