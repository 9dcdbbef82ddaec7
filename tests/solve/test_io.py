"""Weights files: saved models are restored, and invalid files are rejected."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from mocapfix.errors import SceneError
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.lab.cards import write_pose_model
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import trained_priors
from mocapfix.solve.pose_prior import GaussianModel
from tests.solve.test_autoencoder import draw_model

SKELETON = load_cmu31_body().skeleton
CODES = np.random.default_rng(0).normal(size=(3, 3))


@pytest.fixture
def gaussian():
    rng = np.random.default_rng(1)
    reference, residual_sd = np.tile(np.eye(3), (31, 1, 1)), rng.uniform(0.1, 0.3, 31)
    return GaussianModel(
        SKELETON.names, reference, residual_sd, rng.normal(0, 0.1, (31, 3)), rng.normal(0, 0.1, (3, 31, 3)), 0.05
    )


def test_saved_gaussian_is_restored(tmp_path, gaussian):
    write_pose_model(tmp_path / "mine.safetensors", gaussian)
    loaded = trained_priors.load_pose_model(str(tmp_path / "mine.safetensors"), SKELETON)
    assert isinstance(loaded, GaussianModel)
    np.testing.assert_allclose(loaded.decode(CODES), gaussian.decode(CODES), atol=1e-6)
    np.testing.assert_allclose(loaded.encode(gaussian.decode(CODES)), gaussian.encode(gaussian.decode(CODES)), atol=1e-4)
    np.testing.assert_allclose(loaded.residual_information, gaussian.residual_information, rtol=1e-6)


@pytest.mark.parametrize(("features", "activation"), [("continuous", "silu"), ("euler", "relu")])
def test_saved_network_is_restored(tmp_path, features, activation):
    model = draw_model(features, activation)
    halved = {name: weight.astype(np.float16).astype(np.float32) for name, weight in model.weights.items()}
    model = replace(model, weights=halved)
    write_pose_model(tmp_path / "mine.safetensors", model)
    loaded = trained_priors.load_pose_model(str(tmp_path / "mine.safetensors"), SKELETON)
    np.testing.assert_allclose(loaded.decode(CODES), model.decode(CODES), atol=1e-5)
    np.testing.assert_allclose(loaded.linearise(CODES)[1], model.linearise(CODES)[1], atol=1e-4)
    np.testing.assert_allclose(loaded.encode(model.decode(CODES)), model.encode(model.decode(CODES)), atol=1e-4)


def save_changed(tmp_path, model, change):
    """Return the path of a saved model whose header and tensors have been changed."""
    path = tmp_path / "mine.safetensors"
    write_pose_model(path, model)
    header, tensors = {"kind": model.kind, "joints": model.joint_names, **model.serialise()[0]}, load_file(path)
    change(header, tensors)
    save_file(tensors, path, {"mocapfix": json.dumps(header)})
    return str(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda header, tensors: tensors.pop("sigma"), "expected finite tensors"),
        (lambda header, tensors: tensors.update(more=np.ones(2)), "expected finite tensors"),
        (lambda header, tensors: tensors.update(sigma=np.ones(30, np.float32)), "expected finite tensors"),
        (lambda header, tensors: tensors["mean"].__setitem__(0, np.nan), "finite"),
        (lambda header, tensors: header.pop("noise"), "noise"),
        (lambda header, tensors: header.update(kind="forest"), "kind 'forest' is unknown"),
    ],
)
def test_incomplete_or_unknown_content_raises(tmp_path, gaussian, change, message):
    with pytest.raises(SceneError, match=message):
        trained_priors.load_pose_model(save_changed(tmp_path, gaussian, change), SKELETON)


def test_missing_network_weights_raise(tmp_path):
    path = save_changed(
        tmp_path, draw_model("continuous", "silu"), lambda header, tensors: tensors.pop("network.decoder.0.weight")
    )
    with pytest.raises(SceneError, match=r"decoder\.0\.weight"):
        trained_priors.load_pose_model(path, SKELETON)


def test_model_of_other_joints_raises(tmp_path, gaussian):
    path = save_changed(tmp_path, gaussian, lambda header, tensors: header.update(joints=SKELETON.names[::-1]))
    with pytest.raises(SceneError, match="in this order"):
        trained_priors.load_pose_model(path, SKELETON)
    write_pose_model(tmp_path / "mine.safetensors", gaussian)
    with pytest.raises(SceneError, match="in this order"):
        trained_priors.load_pose_model(str(tmp_path / "mine.safetensors"), replace(SKELETON, names=SKELETON.names[:-1]))


def test_missing_and_invalid_files_raise(tmp_path):
    (tmp_path / "text.safetensors").write_text("not that", encoding="utf-8")
    with pytest.raises(SceneError, match=r"text\.safetensors: is not a prior"):
        trained_priors.load_pose_model(str(tmp_path / "text.safetensors"), SKELETON)
    with pytest.raises(SceneError, match="no trained prior 'nobody'"):
        trained_priors.load_pose_model("nobody", SKELETON)


def test_shipped_models_load_and_are_small():
    shipped = sorted(find_shipped_folder("priors").glob("*.safetensors"))
    assert sum(path.stat().st_size for path in shipped) < 25e6
    for path in shipped:
        assert path.with_suffix(".md").is_file()
        assert path.with_suffix(".yaml").is_file()
        if path.stem not in trained_priors.OTHER_WEIGHT_FILES:
            model = trained_priors.load_pose_model(str(path), SKELETON)
            assert (model.residual_sd_rad[1:] >= np.radians(1) - 1e-6).all()
            decoded = model.decode(np.zeros((1, model.code_size)))
            assert np.isfinite(decoded).all()


def test_twist_regressor_is_not_a_pose_prior():
    with pytest.raises(SceneError, match="no trained prior 'twist'; choose one of: autoencoder, gaussian, mixture, pca;"):
        trained_priors.load_pose_model("twist", SKELETON)


def test_gaussian_does_not_import_torch(tmp_path, gaussian):
    path = tmp_path / "mine.safetensors"
    write_pose_model(path, gaussian)
    code = (
        "import sys; from mocapfix.solve import trained_priors; from mocapfix.model.skeleton import load_cmu31_body; "
        f"trained_priors.load_pose_model({str(path)!r}, load_cmu31_body().skeleton); print('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "False"


def test_default_prior_is_linearised_without_torch():
    code = (
        "import sys, numpy as np; from mocapfix.solve import trained_priors; "
        "from mocapfix.model.skeleton import load_cmu31_body; "
        "model = trained_priors.load_pose_model('autoencoder', load_cmu31_body().skeleton); "
        "model.decode(np.zeros((2, model.code_size))); model.linearise(np.zeros((2, model.code_size))); "
        "print('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "False"
