"""Models as files: what was saved comes back, and nothing else is taken for it."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from mocapfix.errors import SceneError
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.pose_prior import io
from mocapfix.pose_prior.gaussian import GaussianModel
from mocapfix.skeleton import load_cmu31_body
from tests.prior.test_autoencoder import drawn

SKELETON = load_cmu31_body().skeleton
CODES = np.random.default_rng(0).normal(size=(3, 3))


@pytest.fixture
def linear():
    rng = np.random.default_rng(1)
    middle, sigma = np.tile(np.eye(3), (31, 1, 1)), rng.uniform(0.1, 0.3, 31)
    return GaussianModel(SKELETON.names, middle, sigma, rng.normal(0, 0.1, (31, 3)), rng.normal(0, 0.1, (3, 31, 3)), 0.05)


def test_a_linear_model_comes_back(tmp_path, linear):
    io.save_pose_model(tmp_path / "mine.safetensors", linear)
    loaded = io.load_pose_model(str(tmp_path / "mine.safetensors"), SKELETON)
    assert isinstance(loaded, GaussianModel)
    np.testing.assert_allclose(loaded.decode(CODES), linear.decode(CODES), atol=1e-6)
    np.testing.assert_allclose(loaded.encode(linear.decode(CODES)), linear.encode(linear.decode(CODES)), atol=1e-4)
    np.testing.assert_allclose(loaded.residual_information, linear.information, rtol=1e-6)


@pytest.mark.parametrize(("kind", "activation"), [("continuous", "silu"), ("euler", "relu")])
def test_a_rounded_network_comes_back_as_it_was(tmp_path, kind, activation):
    model = drawn(kind, activation)
    model.network.half().float()
    io.save_pose_model(tmp_path / "mine.safetensors", model)
    loaded = io.load_pose_model(str(tmp_path / "mine.safetensors"), SKELETON)
    np.testing.assert_allclose(loaded.decode(CODES), model.decode(CODES), atol=1e-5)
    np.testing.assert_allclose(loaded.linearise(CODES)[1], model.linearise(CODES)[1], atol=1e-4)
    np.testing.assert_allclose(loaded.encode(model.decode(CODES)), model.encode(model.decode(CODES)), atol=1e-4)


def spoilt(tmp_path, model, change):
    """-> the path of a saved model whose header and tensors have been changed"""
    path = tmp_path / "mine.safetensors"
    io.save_pose_model(path, model)
    header, tensors = {"kind": type(model).__name__.lower(), "joints": model.joint_names, **model.serialise()[0]}, load_file(path)
    change(header, tensors)
    save_file(tensors, path, {"mocapfix": json.dumps(header)})
    return str(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda header, tensors: tensors.pop("sigma"), "should hold"),
        (lambda header, tensors: tensors.update(more=np.ones(2)), "should hold"),
        (lambda header, tensors: tensors.update(sigma=np.ones(30, np.float32)), "should hold"),
        (lambda header, tensors: tensors["mean"].__setitem__(0, np.nan), "finite"),
        (lambda header, tensors: header.pop("noise"), "noise"),
        (lambda header, tensors: header.update(kind="forest"), "'forest' that is not known"),
    ],
)
def test_a_file_that_lacks_anything_or_has_too_much_is_refused(tmp_path, linear, change, message):
    with pytest.raises(SceneError, match=message):
        io.load_pose_model(spoilt(tmp_path, linear, change), SKELETON)


def test_a_network_of_other_weights_is_refused(tmp_path):
    path = spoilt(tmp_path, drawn("continuous", "silu"), lambda header, tensors: tensors.pop("network.decoder.0.weight"))
    with pytest.raises(SceneError, match=r"decoder\.0\.weight"):
        io.load_pose_model(path, SKELETON)


def test_a_model_of_other_joints_or_another_order_is_refused(tmp_path, linear):
    path = spoilt(tmp_path, linear, lambda header, tensors: header.update(joint_names=SKELETON.names[::-1]))
    with pytest.raises(SceneError, match="in this order"):
        io.load_pose_model(path, SKELETON)
    io.save_pose_model(tmp_path / "mine.safetensors", linear)
    with pytest.raises(SceneError, match="in this order"):
        io.load_pose_model(str(tmp_path / "mine.safetensors"), replace(SKELETON, names=SKELETON.names[:-1]))


def test_another_file_and_no_file_are_refused(tmp_path):
    (tmp_path / "text.safetensors").write_text("not that")
    with pytest.raises(SceneError, match=r"text\.safetensors: is no prior"):
        io.load_pose_model(str(tmp_path / "text.safetensors"), SKELETON)
    with pytest.raises(SceneError, match="no trained prior 'nobody'"):
        io.load_pose_model("nobody", SKELETON)


def test_what_ships_loads_and_is_small():
    shipped = sorted(find_shipped_folder("priors").glob("*.safetensors"))
    assert sum(path.stat().st_size for path in shipped) < 25e6
    for path in shipped:
        assert path.with_suffix(".md").is_file()
        assert path.with_suffix(".yaml").is_file()
        if path.stem not in io.OTHER_WEIGHT_FILES:
            model = io.load_pose_model(str(path), SKELETON)
            assert (model.residual_sd_rad[1:] >= np.radians(1) - 1e-6).all()
            decoded = model.decode(np.zeros((1, model.code_size)))
            assert np.isfinite(decoded).all()


def test_the_regressor_of_twists_is_no_prior():
    with pytest.raises(SceneError, match="no trained prior 'twist'; choose one of: autoencoder, gaussian, mixture, pca;"):
        io.load_pose_model("twist", SKELETON)


def test_a_linear_model_needs_no_torch(tmp_path, linear):
    io.save_pose_model(tmp_path / "mine.safetensors", linear)
    code = "import sys; from mocapfix.pose_prior.mean_pose import models; from mocapfix.skeleton import cmu31; "
    code += f"models.load({str(tmp_path / 'mine.safetensors')!r}, cmu31().skeleton); print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "False"
