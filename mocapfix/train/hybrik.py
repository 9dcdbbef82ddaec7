"""HybrIK on torch tensors, to be trained through: the same poses as `initialise.hybrik`, and how they change with what is given.

The formulas are the kernels' own (`kernels.twist_swing`); here is only the recursion, a joint of all frames at a time.
"""

import numpy as np
import torch

from mocapfix.initialise.bones import MarkedSubject, build_bones, find_stub_joints
from mocapfix.initialise.hybrik import DEFAULT_JOINT_SD_M, HybrikVariant
from mocapfix.kernels.hybrik import HybrikSkeleton
from mocapfix.kernels.joint_registration import RootPoints
from mocapfix.kernels.swing_twist import compute_swing, compute_twist, compute_twist_evidence, solve_two_bone_joint
from mocapfix.pose_prior import mean_pose
from mocapfix.skeleton import load_cmu31_body
from mocapfix.subject import Subject


def hybrik(
    positions: torch.Tensor,
    twists: torch.Tensor,
    subject: Subject,
    way: HybrikVariant = "x",
    deviation: float = DEFAULT_JOINT_SD_M,
) -> tuple[torch.Tensor, torch.Tensor]:
    """-> the root's place (T, 3) in metres and local rotations (T, J, 3, 3), differentiable in both that is given.

    positions  (T, J, 3) metres, all of them known
    twists     (T, J, 2) cosine and sine of the angle about each bone, times how sure it is, 1/rad^2; never of length 0
    deviation  metres per axis: how far a joint is from where it is given
    """
    skeleton, habits = subject.skeleton, mean_pose.load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton)
    held = find_stub_joints(skeleton, habits) if way == "x" else np.zeros(len(skeleton.names), bool)
    bones, carried = build_bones(skeleton, habits, MarkedSubject(subject, False), held)
    place, turn = registered(carried, positions, deviation, way == "x")
    rest = torch.as_tensor(habits.mean_rotations, dtype=positions.dtype)
    local, world, at = [turn], [turn], [place]
    for j in range(1, len(skeleton.names)):
        p = int(bones.parents[j])
        at.append(at[p] + world[p] @ torch.as_tensor(bones.offsets[j], dtype=positions.dtype))
        turned = rest[j].expand(len(positions), 3, 3)
        if bones.is_solved[j]:
            turned = turn_of(j, bones, way, positions, twists[:, j], at[j], world[p], deviation)
        local.append(turned)
        world.append(world[p] @ turned)
    return place, torch.stack(local, dim=1)


def registered(carried: RootPoints, positions: torch.Tensor, deviation: float, refine: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """-> place (T, 3) and turn (T, 3, 3) of the root: the singular value decomposition of HybrIK's appendix A, mirrored back
    where the last singular vector would make it a reflection."""
    rest = torch.as_tensor(carried.rest_position, dtype=positions.dtype)
    weight = 1 / torch.as_tensor(deviation**2 + carried.position_variance, dtype=positions.dtype)[:, None]
    seen = positions[:, torch.as_tensor(carried.point_index)]
    there, here = (weight * rest).sum(0) / weight.sum(), (weight * seen).sum(1) / weight.sum()
    cross = (weight * (seen - here[:, None])).mT @ (rest - there)
    u, _, v = torch.linalg.svd(cross)
    proper = torch.diag_embed(torch.stack([torch.ones_like(cross[:, 0, 0])] * 2 + [torch.det(u @ v)], dim=-1))
    turn = u @ proper @ v
    return (here - turn @ there if refine else positions[:, 0]), turn


def turn_of(j, bones: HybrikSkeleton, way: HybrikVariant, positions, twists, at, parent, deviation: float) -> torch.Tensor:
    """-> (T, 3, 3) the turn of one joint that lies `at` (T, 3), on a parent turned by (T, 3, 3) in the world."""
    origin = positions[:, j] if way == "naive" else at
    place, there, mine = np.zeros(3), torch.zeros_like(at), range(bones.first_point[j], bones.first_point[j + 1])
    for i in mine:
        if bones.is_child[i]:
            w, child = weight(bones, i, deviation), bones.point_index[i]
            end, target = int(bones.conflict_joint[j]), positions[:, child]
            if way == "x" and end >= 0 and bones.parents[end] == child:
                upper, lower = np.linalg.norm(bones.offsets[child]), np.linalg.norm(bones.offsets[end])
                root = subtree_root(end, bones, positions, deviation)
                target = torch.stack(solve_two_bone_joint(split(at), split(target), split(root), upper, lower)[0], dim=-1)
            place, there = place + w * bones.rest_position[i], there + w * (target - origin)
    swung = square(compute_swing(tuple(place), split((parent.mT @ there[..., None])[..., 0])), at)
    cosine, sine = twists.unbind(-1)
    for i in (i for i in mine if bones.constrains_twist[i]):
        off = positions[:, bones.point_index[i]] - (origin if bones.is_child[i] else at)
        c, s = compute_twist_evidence(
            tuple(place), tuple(bones.rest_position[i]), split((swung.mT @ parent.mT @ off[..., None])[..., 0])
        )
        cosine, sine = cosine + weight(bones, i, deviation) * c, sine + weight(bones, i, deviation) * s
    return swung @ square(compute_twist(tuple(place), cosine, sine), at)


def subtree_root(j: int, bones: HybrikSkeleton, positions: torch.Tensor, deviation: float) -> torch.Tensor:
    """-> (T, 3) metres: where the sub-tree that hangs on a conflict joint puts it, see `kernels.hybrik`."""
    place, there, total = np.zeros(3), torch.zeros_like(positions[:, j]), 0.0
    for i in range(bones.first_point[j], bones.first_point[j + 1]):
        if bones.is_child[i]:
            w = weight(bones, i, deviation)
            place, there = place + w * bones.rest_position[i], there + w * (positions[:, bones.point_index[i]] - positions[:, j])
            total += w
    if not total:
        return positions[:, j]
    share = 1 / (total + 1 / deviation**2)
    return positions[:, j] + share * (1 - np.linalg.norm(place) / torch.linalg.norm(there, dim=-1, keepdim=True)) * there


def weight(bones: HybrikSkeleton, i: int, deviation: float) -> float:
    """-> 1/m^2: what one of the points counts, `deviation` metres per axis being a joint's."""
    return float(1 / (deviation**2 + bones.position_variance[i]))


def split(vectors: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """-> (..., 3) as the formulas want it, three tensors."""
    return vectors.unbind(-1)


def square(nine: tuple, like: torch.Tensor) -> torch.Tensor:
    """-> nine tensors or numbers, row by row, as (T, 3, 3)."""
    return torch.stack([torch.as_tensor(each, dtype=like.dtype).expand(len(like)) for each in nine], dim=-1).reshape(-1, 3, 3)
