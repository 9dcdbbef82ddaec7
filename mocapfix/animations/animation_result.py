"""The result of cleaning an animation."""

import shutil
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from mocapfix.animation import Animation
from mocapfix.animations.joint_points import build_joint_skeleton
from mocapfix.result import CleaningResult
from mocapfix.take import Take
from mocapfix.write.animation_patch import patch_animation

if TYPE_CHECKING:
    from mocapfix.report.comparison import CleaningComparison


@dataclass(frozen=True, kw_only=True)
class AnimationResult(CleaningResult):
    """A cleaned animation.

    The takes `input_take`, `relabelled_take` and `take` hold the joint tips (see `joint_points.build_tip_take`). Subject and
    motion are those of the 31-joint skeleton, None if the joint names are not those of a body.

    input_animation, animation  as read, and cleaned
    joint_take  joint positions of the cleaned animation
    """

    input_animation: Animation
    animation: Animation
    joint_take: Take

    @property
    def output_take(self) -> Take:
        """The points that files of points hold: the joint positions of the cleaned animation."""
        return self.joint_take

    def write_source_copy(self, target: Path) -> list[tuple[int, int]]:
        """Write a copy of the input file with the changed values replaced; for an AMC also a copy of its ASF.

        Returns an empty list: the file stores every value, or WriteError is raised.
        """
        patch_animation(target, self.input_animation, self.animation.values)
        if self.input_animation.skeleton_path:
            shutil.copyfile(self.input_animation.skeleton_path, target.with_suffix(".asf"))
        return []

    @cached_property
    def comparison(self) -> "CleaningComparison":
        """The animation before and after cleaning, for the report and the recording."""
        skeleton, positions = build_joint_skeleton(self.animation)
        return replace(super().comparison, skeleton=skeleton, joint_position_world=positions)
