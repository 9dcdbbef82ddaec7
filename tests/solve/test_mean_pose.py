import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from mocapfix.errors import SceneError
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import mean_pose
from mocapfix.solve.mean_pose import MeanPosePrior, load_joint_limits

SKELETON = load_cmu31_body().skeleton
SHIPPED = find_shipped_folder("priors") / "mean-pose.yaml"


@pytest.fixture
def write_changed_prior(tmp_path, monkeypatch):
    """Return a function that writes a changed copy of the shipped prior as "mine" to an otherwise empty folder of priors."""
    monkeypatch.setattr(mean_pose, "find_shipped_folder", lambda name: tmp_path)

    def write(change):
        data = yaml.safe_load(SHIPPED.read_text(encoding="utf-8"))
        change(data)
        (tmp_path / "mine.yaml").write_text(yaml.safe_dump(data), encoding="utf-8")
        return tmp_path / "mine.yaml"

    return write


def test_shipped_prior_has_the_values_of_its_file():
    loaded = mean_pose.load_mean_pose_prior("mean-pose", SKELETON)
    entries = yaml.safe_load(SHIPPED.read_text(encoding="utf-8"))["joints"]
    for name, joint in entries.items():
        j = SKELETON.find_joint(name)
        xx, yy, zz, xy, xz, yz = joint["covariance"]
        np.testing.assert_allclose(loaded.information[j] @ [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], np.eye(3), atol=1e-9)
        np.testing.assert_allclose(loaded.mean_rotations[j], Rotation.from_quat(joint["quaternion_xyzw"]).as_matrix(), atol=1e-12)
    assert set(entries) == set(SKELETON.names[1:])


def test_shipped_mean_pose_has_arms_down_knees_bent_and_is_symmetric():
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
def test_prior_has_information_about_every_joint_except_the_root(name):
    loaded = mean_pose.load_mean_pose_prior(name, SKELETON)
    assert loaded.name == name
    assert not loaded.information[0].any()
    np.testing.assert_array_equal(loaded.mean_rotations[0], np.eye(3))
    np.testing.assert_allclose(loaded.information, np.swapaxes(loaded.information, 1, 2), atol=1e-9)
    assert (np.linalg.eigvalsh(loaded.information[1:]) > 0).all()
    np.testing.assert_allclose(np.linalg.det(loaded.mean_rotations), 1.0)


def test_prior_none_is_a_weak_rest_pose():
    loaded = mean_pose.load_mean_pose_prior("none", SKELETON)
    np.testing.assert_array_equal(loaded.mean_rotations, np.tile(np.eye(3), (31, 1, 1)))
    np.testing.assert_allclose(loaded.information[1:], np.tile(np.eye(3) / 9, (30, 1, 1)))


@pytest.mark.parametrize("name", ["nobody", "../mean-posed", "", "mean-pose.yaml", "shape"])
def test_unknown_prior_raises_and_lists_available_priors(name):
    with pytest.raises(SceneError) as raised:
        mean_pose.load_mean_pose_prior(name, SKELETON)
    assert str(raised.value) == f"There is no prior named {name!r}; choose one of: mean-pose, none."


CHANGES = {
    "no such joint": lambda data: data["joints"].pop("LeftArm"),
    "no covariance": lambda data: data["joints"]["LeftArm"].pop("covariance"),
    "five numbers": lambda data: data["joints"]["LeftArm"]["covariance"].pop(),
    "text": lambda data: data["joints"]["LeftArm"].update(covariance="wide"),
    "zero covariance": lambda data: data["joints"]["LeftArm"].update(covariance=[0] * 6),
    "no locked axes": lambda data: data["joints"]["LeftArm"].pop("locked_axes"),
    "half an axis": lambda data: data["joints"]["LeftArm"].update(locked_axes=[[1.0, 0.0]]),
    "no quaternion": lambda data: data["joints"]["LeftArm"].update(quaternion_xyzw=[0, 0, 0, 0]),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_incomplete_prior_raises_with_file_and_joint(write_changed_prior, change):
    path = write_changed_prior(change)
    with pytest.raises(SceneError) as raised:
        mean_pose.load_mean_pose_prior("mine", SKELETON)
    assert str(raised.value).startswith(f"{path}: joints.LeftArm must hold quaternion_xyzw, covariance and between_takes (xx, yy")
    assert str(raised.value).endswith("locked_axes.")


def test_prior_without_joints_raises(write_changed_prior):
    path = write_changed_prior(lambda data: data.pop("joints"))
    with pytest.raises(SceneError, match=f"{path.name}: joints.LHipJoint must hold"):
        mean_pose.load_mean_pose_prior("mine", SKELETON)


def test_scaling_information_does_not_change_locked_axes():
    axes = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    hinge = np.outer(axes[:, 0], axes[:, 0])
    information = axes * np.array([25.0, 8.0, 2.0]) @ axes.T
    loaded = MeanPosePrior("", np.eye(3)[None], information[None], 25.0 * hinge[None], np.zeros((1, 3, 3)))
    for weight in (0.1, 1.0):
        weak = loaded.scale_information(weight)
        np.testing.assert_allclose(weak.information[0], axes * np.array([25, 8 * weight, 2 * weight]) @ axes.T, atol=1e-12)
        np.testing.assert_allclose(weak.locked_information[0], 25 * hinge, atol=1e-12)


def test_within_and_between_take_covariance_add_up():
    loaded = mean_pose.load_mean_pose_prior("mean-pose", SKELETON)
    whole = np.linalg.inv(loaded.information[1:])
    within = np.linalg.inv(loaded.build_within_take_prior().information[1:])
    np.testing.assert_allclose(within + loaded.between_take_covariance[1:], whole, atol=1e-9)
    assert np.linalg.eigvalsh(loaded.build_within_take_prior().information[1:]).min() > 0
    assert not loaded.between_take_covariance[SKELETON.find_joint("LHipJoint")].any()  # locked


def test_knees_and_hip_stubs_are_locked_and_hips_are_not():
    loaded = mean_pose.load_mean_pose_prior("mean-pose", SKELETON)
    ranks = [
        np.linalg.matrix_rank(loaded.locked_information[SKELETON.find_joint(name)], tol=1e-3)
        for name in ("LHipJoint", "LeftLeg", "LeftUpLeg")
    ]
    assert ranks[0] == 3
    assert ranks[1] >= 1
    assert ranks[2] == 0
    strengths = np.linalg.eigvalsh(loaded.information - loaded.locked_information)
    assert strengths.min() > -1e-2 * loaded.information.max()  # the locked part does not exceed the whole


# joint limits


def test_shipped_limits_contain_the_mean_pose_and_leave_the_root_free():
    limits = load_joint_limits(SKELETON)
    assert (limits.lower_rad < 0).all()
    assert (limits.upper_rad > 0).all()
    assert np.isinf([limits.lower_rad[0], limits.upper_rad[0]]).all()
    assert np.isfinite([limits.lower_rad[1:], limits.upper_rad[1:]]).all()
    np.testing.assert_array_equal(limits.mean_rotations, mean_pose.load_mean_pose_prior("mean-pose", SKELETON).mean_rotations)


def test_shipped_limits_are_symmetric():
    limits = load_joint_limits(SKELETON)
    for name in ("UpLeg", "Leg", "Foot", "Arm", "ForeArm", "Hand"):
        left, right = (SKELETON.find_joint(side + name) for side in ("Left", "Right"))
        np.testing.assert_allclose(limits.lower_rad[left] * [1, 0, 0], limits.lower_rad[right] * [1, 0, 0], atol=2e-3)
        np.testing.assert_allclose(limits.lower_rad[left, 1:], -limits.upper_rad[right, 1:], atol=2e-3)


def test_straight_knee_is_within_limits_and_backward_bent_knee_is_not():
    limits, knee = load_joint_limits(SKELETON), SKELETON.find_joint("LeftLeg")
    for degrees, within in ((0.0, True), (90.0, True), (-40.0, False)):
        bent = Rotation.from_euler("x", degrees, degrees=True).as_matrix() @ limits.mean_rotations[knee].T
        away = Rotation.from_matrix(bent).as_rotvec()
        assert ((limits.lower_rad[knee] - 1e-3 <= away) & (away <= limits.upper_rad[knee] + 1e-3)).all() == within


LIMIT_CHANGES = {
    "no such joint": (lambda data: data["joints"].pop("LeftArm"), "joints.LeftArm must hold low and high (x, y, z)."),
    "no low": (lambda data: data["joints"]["LeftArm"].pop("low"), "joints.LeftArm must hold low and high (x, y, z)."),
    "two numbers": (lambda data: data["joints"]["LeftArm"]["high"].pop(), "joints.LeftArm must hold low and high (x, y, z)."),
    "text": (
        lambda data: data["joints"]["LeftArm"].update(low=["far", 0, 0]),
        "joints.LeftArm must hold low and high (x, y, z).",
    ),
    "upside down": (
        lambda data: data["joints"]["LeftArm"].update(low=[4, 4, 4]),
        "the low limits of joints.LeftArm must be below its high limits.",
    ),
}


@pytest.mark.parametrize(("change", "message"), LIMIT_CHANGES.values(), ids=LIMIT_CHANGES.keys())
def test_invalid_limits_raise_with_file_and_joint(tmp_path, monkeypatch, change, message):
    data = yaml.safe_load((SHIPPED.parent / "joint-limits.yaml").read_text(encoding="utf-8"))
    change(data)
    (tmp_path / "joint-limits.yaml").write_text(yaml.safe_dump(data), encoding="utf-8")
    (tmp_path / "mean-pose.yaml").write_bytes(SHIPPED.read_bytes())
    monkeypatch.setattr(mean_pose, "find_shipped_folder", lambda name: tmp_path)
    with pytest.raises(SceneError) as raised:
        load_joint_limits(SKELETON)
    assert str(raised.value) == f"{tmp_path / 'joint-limits.yaml'}: {message}"


def test_joint_limits_are_not_a_pose_prior():
    with pytest.raises(SceneError, match="no prior named 'joint-limits'; choose one of: mean-pose"):
        mean_pose.load_mean_pose_prior("joint-limits", SKELETON)
