"""Hands in the add-on: palm, fingers and tips of a take are where they were solved."""

import json

import numpy as np
import pytest

from mocapfix.io.npz import write_npz
from mocapfix.model.take import Take
from tests.addon.addon_modules import load_addon_module
from tests.hands.test_attach_hands import RATE_HZ, compose_hands_on_body

axes, bvh_file, solved_take = (load_addon_module(name) for name in ("axes", "bvh_file", "solved_take"))


@pytest.mark.parametrize("step", [1, 2])
def test_palms_joints_and_tips_are_where_they_were_solved(tmp_path, step):
    skeleton, motion, hands = compose_hands_on_body()
    frames = np.arange(0, motion.frame_count, step)
    take = Take(np.zeros((motion.frame_count, 1, 3)), ("A",), RATE_HZ)
    write_npz(tmp_path / "walk.npz", take, skeleton, motion.select_frames(frames), RATE_HZ / step, None, None, hands=hands)
    (tmp_path / "walk.report.json").write_text(json.dumps({"take": {}}), encoding="utf-8")
    body = solved_take.read_solved_take(tmp_path / "walk.npz").body
    places = bvh_file.compute_joint_positions(body, np.arange(len(frames)))
    assert len(body.names) == len(set(body.names)) == 31 + 2 * 16
    for hand in hands:
        palm = body.names.index(f"{hand.hand.model.side}Palm")
        solved = np.concatenate([hand.palm_position[:, None], hand.point_positions[:, :15]], axis=1)[frames]
        np.testing.assert_allclose(places[:, palm : palm + 16], axes.convert_points(solved), atol=1e-6)
        assert [
            name for name, end in zip(body.names[palm:], body.ends[palm : palm + 16], strict=False) if np.isfinite(end).all()
        ] == [f"{hand.hand.model.side}{finger}Distal" for finger in ("Thumb", "Index", "Middle", "Ring", "Little")]
        lengths = np.linalg.norm(body.ends[palm + 3 : palm + 16 : 3], axis=1)
        np.testing.assert_allclose(lengths, np.linalg.norm(hand.hand.model.tips, axis=1), atol=1e-6)
