import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.motion import FrameStatus
from mocapfix.solve import kinematics
from mocapfix.take import Take
from mocapfix.write import npz
from tests.write.read_back import SKELETON, motion_of, smooth_rotations

MARKERS = np.random.default_rng(0).normal(size=(50, 3, 3))
MARKERS[7, 1] = np.nan
SURE = np.full((50, 3), np.nan)
SURE[9, 2] = 0.004
TAKE = Take(MARKERS, ("LFHD", "Jim:RFHD", "ß"), 120.0, first_frame=301, sample_sd=SURE)


def test_what_is_written_loads_without_pickle_and_is_what_was_solved(tmp_path):
    motion = motion_of(smooth_rotations(0, 25, 31, swing=4), np.random.default_rng(1).normal(size=(25, 3)))
    npz(tmp_path / "walk.npz", TAKE, SKELETON, motion, 60.0)
    with np.load(tmp_path / "walk.npz", allow_pickle=False) as file:
        found = {name: file[name] for name in file.review_files}
    assert str(found["format"]) == "mocapfix 1"
    assert (float(found["rate"]), float(found["marker_rate"]), int(found["first_frame"])) == (60, 120, 301)
    assert (tuple(found["names"]), tuple(found["labels"]), tuple(found["status_texts"])) == (
        SKELETON.names,
        TAKE.labels,
        [status.description for status in FrameStatus],
    )
    for name, array in (("markers", MARKERS), ("marker_sd", SURE), ("root", motion.root), ("status", motion.status)):
        np.testing.assert_array_equal(found[name], array)
    for name in ("parents", "offsets", "ends"):
        np.testing.assert_array_equal(found[name], getattr(SKELETON, name))
    turns = Rotation.from_quat(found["rotations"].reshape(-1, 4)).as_matrix().reshape(25, 31, 3, 3)
    np.testing.assert_allclose(turns, motion.local_rotations, atol=1e-12)
    assert ((found["rotations"][1:] * found["rotations"][:-1]).sum(-1) > 0).all()  # no flips
    np.testing.assert_allclose(found["joints"], kinematics.compute_world_poses(SKELETON, motion)[0])


def test_a_take_without_a_body_has_its_markers_alone(tmp_path):
    npz(tmp_path / "walk.npz", TAKE)
    with np.load(tmp_path / "walk.npz", allow_pickle=False) as file:
        assert set(file.review_files) == {
            "format",
            "units",
            "rate",
            "first_frame",
            "labels",
            "markers",
            "marker_sd",
            "marker_rate",
        }
        assert float(file["rate"]) == 120
        assert np.isnan(file["markers"][7, 1]).all()
