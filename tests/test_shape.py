"""The shape parameters that ship, and files that do not say what they must."""

import numpy as np
import pytest

from mocapfix import skeleton
from mocapfix.errors import SceneError
from mocapfix.skeleton import load_cmu31_body, load_cmu31_skeleton
from mocapfix.train.training_poses import mirror_joint_name

SHAPES, NAMES = load_cmu31_body().shape_components, load_cmu31_skeleton().names


def test_components_are_listed_joint_by_joint(tmp_path):
    path = tmp_path / "two.yaml"
    path.write_text("components:\n- {b: [1, 2.5, -3]}\n- {a: [0, 0, 0.1], c: [4, 5, 6]}\n")
    expected = [[[0, 0, 0], [1, 2.5, -3], [0, 0, 0]], [[0, 0, 0.1], [0, 0, 0], [4, 5, 6]]]
    np.testing.assert_array_equal(skeleton.load_shape_components(path, ("a", "b", "c")), expected)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("bones: []", r"components must be a list"),
        ("components: 3", r"components must be a list"),
        ("components:\n- {a: [0, 0, 0]}\n- {tail: [0, 0, 0]}", r"components\.1 must give joints"),
        ("components:\n- {a: [0, 0]}", r"components\.0 must give joints"),
        ("components:\n- {a: [0, 0, long]}", r"components\.0 must give joints"),
        ("components:\n- {a: 0.1}", r"components\.0 must give joints"),
        ("components:\n- a", r"components\.0 must give joints"),
    ],
)
def test_a_wrong_file_names_the_component(tmp_path, text, said):
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(SceneError, match=rf"wrong\.yaml: {said}"):
        skeleton.load_shape_components(path, ("a", "b", "c"))


def test_the_shipped_components_are_a_bodys_and_fall_off():
    sizes = np.sqrt((SHAPES**2).sum(axis=(1, 2)))
    assert len(SHAPES) == 10
    assert (np.diff(sizes) <= 0).all()
    assert sizes[0] < 0.04  # metres, all joints together: people differ by centimetres
    flat = SHAPES.reshape(10, -1)
    np.testing.assert_allclose(flat @ flat.T, np.diag(sizes**2), atol=1e-6)


def test_no_component_is_a_change_of_size():
    offsets = load_cmu31_skeleton().offsets
    along = np.einsum("pja,ja->p", SHAPES, offsets) / (offsets**2).sum()
    np.testing.assert_allclose(along, 0, atol=1e-4)


def test_each_component_is_alike_or_opposite_on_both_sides():
    other = [NAMES.index(mirror_joint_name(name)) for name in NAMES]
    mirrored = SHAPES[:, other] * [-1, 1, 1]
    sign = np.sign((mirrored * SHAPES).sum(axis=(1, 2)))
    np.testing.assert_allclose(mirrored, sign[:, None, None] * SHAPES, atol=2e-5)
