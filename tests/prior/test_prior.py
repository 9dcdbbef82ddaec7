import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from mocapfix.errors import SceneError
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import load_cmu31_body

SKELETON = load_cmu31_body().skeleton
SHIPPED = find_shipped_folder("priors") / "mean-pose.yaml"


@pytest.fixture
def shelf(tmp_path, monkeypatch):
    """-> a function that puts a changed copy of the shipped prior on an otherwise empty shelf, as "mine" """
    monkeypatch.setattr(mean_pose, "folder", lambda name: tmp_path)

    def put(change):
        data = yaml.safe_load(SHIPPED.read_text(encoding="utf-8"))
        change(data)
        (tmp_path / "mine.yaml").write_text(yaml.safe_dump(data), encoding="utf-8")
        return tmp_path / "mine.yaml"

    return put


def test_the_shipped_prior_says_what_its_file_says():
    loaded, said = (
        mean_pose.load_mean_pose_prior("mean-pose", SKELETON),
        yaml.safe_load(SHIPPED.read_text(encoding="utf-8"))["joints"],
    )
    for name, joint in said.items():
        j = SKELETON.find_joint(name)
        xx, yy, zz, xy, xz, yz = joint["covariance"]
        np.testing.assert_allclose(loaded.information[j] @ [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], np.eye(3), atol=1e-9)
        np.testing.assert_allclose(loaded.mean_rotations[j], Rotation.from_quat(joint["quaternion_xyzw"]).as_matrix(), atol=1e-12)
    assert set(said) == set(SKELETON.names[1:])


def test_the_shipped_mean_pose_is_a_person_arms_down_knees_bent_alike_on_both_sides():
    rotations = mean_pose.load_mean_pose_prior("mean-pose", SKELETON).mean_rotations
    down = rotations[SKELETON.find_joint("LeftShoulder")] @ rotations[SKELETON.find_joint("LeftArm")] @ [1, 0, 0]
    assert down[1] < -0.5
    knee = Rotation.from_matrix(rotations[SKELETON.find_joint("LeftLeg")]).as_rotvec()
    assert np.radians(10) < knee[0] < np.radians(70)
    mirror = np.diag([-1.0, 1, 1])
    for side in ("Arm", "Leg", "UpLeg", "ForeArm"):
        left, right = (rotations[SKELETON.find_joint(name + side)] for name in ("Left", "Right"))
        np.testing.assert_allclose(left, mirror @ right @ mirror, atol=1e-4)


@pytest.mark.parametrize("name", ["mean-pose", "none"])
def test_a_prior_pulls_every_joint_but_the_root(name):
    loaded = mean_pose.load_mean_pose_prior(name, SKELETON)
    assert loaded.name == name
    assert not loaded.information[0].any()
    np.testing.assert_array_equal(loaded.mean_rotations[0], np.eye(3))
    np.testing.assert_allclose(loaded.information, np.swapaxes(loaded.information, 1, 2), atol=1e-9)
    assert (np.linalg.eigvalsh(loaded.information[1:]) > 0).all()
    np.testing.assert_allclose(np.linalg.det(loaded.mean_rotations), 1.0)


def test_none_is_the_rest_pose_held_weakly():
    loaded = mean_pose.load_mean_pose_prior("none", SKELETON)
    np.testing.assert_array_equal(loaded.mean_rotations, np.tile(np.eye(3), (31, 1, 1)))
    np.testing.assert_allclose(loaded.information[1:], np.tile(np.eye(3) / 9, (30, 1, 1)))


@pytest.mark.parametrize("name", ["nobody", "../mean-posed", "", "mean-pose.yaml", "shape"])
def test_an_unknown_prior_is_told_with_the_ones_there_are(name):
    with pytest.raises(SceneError) as told:
        mean_pose.load_mean_pose_prior(name, SKELETON)
    assert str(told.value) == f"There is no prior named {name!r}; choose one of: mean-pose, none."


CHANGES = {
    "no such joint": lambda data: data["joints"].pop("LeftArm"),
    "no covariance": lambda data: data["joints"]["LeftArm"].pop("covariance"),
    "five numbers": lambda data: data["joints"]["LeftArm"]["covariance"].pop(),
    "a word": lambda data: data["joints"]["LeftArm"].update(compute_covariance="wide"),
    "no spread at all": lambda data: data["joints"]["LeftArm"].update(compute_covariance=[0] * 6),
    "no held axes": lambda data: data["joints"]["LeftArm"].pop("held"),
    "half an axis": lambda data: data["joints"]["LeftArm"].update(locked_information=[[1.0, 0.0]]),
    "no quaternion": lambda data: data["joints"]["LeftArm"].update(quaternion_xyzw=[0, 0, 0, 0]),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_a_prior_that_does_not_say_what_it_must_is_told_by_file_and_joint(shelf, change):
    path = shelf(change)
    with pytest.raises(SceneError) as told:
        mean_pose.load_mean_pose_prior("mine", SKELETON)
    assert str(told.value).startswith(f"{path}: joints.LeftArm must hold quaternion_xyzw, covariance and between (xx, yy")
    assert str(told.value).endswith("held.")


def test_a_prior_without_joints_is_told(shelf):
    path = shelf(lambda data: data.pop("joints"))
    with pytest.raises(SceneError, match=f"{path.name}: joints.LHipJoint must hold"):
        mean_pose.load_mean_pose_prior("mine", SKELETON)


def test_weakening_spares_the_axes_that_the_skeleton_itself_holds():
    axes = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    hinge = np.outer(axes[:, 0], axes[:, 0])
    information = axes * np.array([25.0, 8.0, 2.0]) @ axes.T
    loaded = MeanPosePrior("", np.eye(3)[None], information[None], 25.0 * hinge[None], np.zeros((1, 3, 3)))
    for weight in (0.1, 1.0):
        weak = loaded.scale_information(weight)
        np.testing.assert_allclose(weak.information[0], axes * np.array([25, 8 * weight, 2 * weight]) @ axes.T, atol=1e-12)
        np.testing.assert_allclose(weak.locked_information[0], 25 * hinge, atol=1e-12)


def test_what_a_take_varies_by_and_what_takes_vary_by_add_up():
    loaded = mean_pose.load_mean_pose_prior("mean-pose", SKELETON)
    whole = np.linalg.inv(loaded.information[1:])
    within = np.linalg.inv(loaded.build_within_take_prior().information[1:])
    np.testing.assert_allclose(within + loaded.between_take_covariance[1:], whole, atol=1e-9)
    assert np.linalg.eigvalsh(loaded.build_within_take_prior().information[1:]).min() > 0
    assert not loaded.between_take_covariance[SKELETON.find_joint("LHipJoint")].any()  # which is held


def test_knees_and_hip_stubs_are_held_and_hips_are_not():
    loaded = mean_pose.load_mean_pose_prior("mean-pose", SKELETON)
    ranks = [
        np.linalg.matrix_rank(loaded.locked_information[SKELETON.find_joint(name)], tol=1e-3)
        for name in ("LHipJoint", "LeftLeg", "LeftUpLeg")
    ]
    assert ranks[0] == 3
    assert ranks[1] >= 1
    assert ranks[2] == 0
    strengths = np.linalg.eigvalsh(loaded.information - loaded.locked_information)
    assert strengths.min() > -1e-2 * loaded.information.max()  # held is a part of it


# joint limits


def test_the_shipped_limits_hold_the_mean_pose_and_leave_the_root_free():
    limits = mean_pose.load_joint_limits(SKELETON)
    assert (limits.lower_rad < 0).all()
    assert (limits.upper_rad > 0).all()
    assert np.isinf([limits.lower_rad[0], limits.upper_rad[0]]).all()
    assert np.isfinite([limits.lower_rad[1:], limits.upper_rad[1:]]).all()
    np.testing.assert_array_equal(limits.mean_rotations, mean_pose.load_mean_pose_prior("mean-pose", SKELETON).mean_rotations)


def test_the_shipped_limits_are_mirrored_between_the_sides():
    limits = mean_pose.load_joint_limits(SKELETON)
    for name in ("UpLeg", "Leg", "Foot", "Arm", "ForeArm", "Hand"):
        left, right = (SKELETON.find_joint(side + name) for side in ("Left", "Right"))
        np.testing.assert_allclose(limits.lower_rad[left] * [1, 0, 0], limits.lower_rad[right] * [1, 0, 0], atol=2e-3)
        np.testing.assert_allclose(limits.lower_rad[left, 1:], -limits.upper_rad[right, 1:], atol=2e-3)


def test_a_straight_knee_is_within_the_limits_and_one_bent_backwards_is_not():
    limits, knee = mean_pose.load_joint_limits(SKELETON), SKELETON.find_joint("LeftLeg")
    for degrees, within in ((0.0, True), (90.0, True), (-40.0, False)):
        bent = Rotation.from_euler("x", degrees, degrees=True).as_matrix() @ limits.mean_rotations[knee].T
        away = Rotation.from_matrix(bent).as_rotvec()
        assert ((limits.lower_rad[knee] - 1e-3 <= away) & (away <= limits.upper_rad[knee] + 1e-3)).all() == within


LIMIT_CHANGES = {
    "no such joint": (lambda data: data["joints"].pop("LeftArm"), "must hold low and high (x, y, z)."),
    "no low": (lambda data: data["joints"]["LeftArm"].pop("low"), "must hold low and high (x, y, z)."),
    "two numbers": (lambda data: data["joints"]["LeftArm"]["high"].pop(), "must hold low and high (x, y, z)."),
    "a word": (lambda data: data["joints"]["LeftArm"].update(lower_rad=["far", 0, 0]), "must hold low and high (x, y, z)."),
    "upside down": (lambda data: data["joints"]["LeftArm"].update(lower_rad=[4, 4, 4]), "has a low that is not below its high."),
}


@pytest.mark.parametrize(("change", "told"), LIMIT_CHANGES.values(), ids=LIMIT_CHANGES.keys())
def test_limits_that_do_not_say_what_they_must_are_told_by_file_and_joint(tmp_path, monkeypatch, change, told):
    data = yaml.safe_load((SHIPPED.parent / "joint-limits.yaml").read_text(encoding="utf-8"))
    change(data)
    (tmp_path / "joint-limits.yaml").write_text(yaml.safe_dump(data), encoding="utf-8")
    (tmp_path / "mean-pose.yaml").write_bytes(SHIPPED.read_bytes())
    monkeypatch.setattr(mean_pose, "folder", lambda name: tmp_path)
    with pytest.raises(SceneError) as raised:
        mean_pose.load_joint_limits(SKELETON)
    assert str(raised.value) == f"{tmp_path / 'joint-limits.yaml'}: joints.LeftArm {told}"


def test_the_limits_are_no_prior_of_poses():
    with pytest.raises(SceneError, match="no prior named 'joint-limits'; choose one of: mean-pose"):
        mean_pose.load_mean_pose_prior("joint-limits", SKELETON)
