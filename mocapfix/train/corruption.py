"""Spoiling poses, for a network to mend: what it learns is the way back to people's poses from beside them."""

import torch
from torch import Generator, Tensor

from mocapfix.skeleton import cmu31

NOISE = 0.35  # radians: the most that all joints' noise deviates, drawn per pose
STRONG = 1.0  # radians: the deviation of a limb that is all noise
SPOILED = 0.6  # of the poses lose limbs
LIMB = 0.22  # of the limbs of these
LIMBS = ("LeftShoulder", "RightShoulder", "LHipJoint", "RHipJoint", "Neck")  # each with all that hangs on it


def limbs() -> Tensor:
    """-> (L, J) bool: which joints belong to which limb."""
    skeleton = cmu31().skeleton
    rows = torch.zeros(len(LIMBS), len(skeleton.names), dtype=torch.bool)
    for row, first in zip(rows, LIMBS, strict=True):
        for j, name in enumerate(skeleton.names):
            row[j] = name == first or bool(row[skeleton.parents[j]])  # parents come before children; the root is no limb's
    return rows


def spoiled(vectors: Tensor, of_limbs: Tensor, generator: Generator) -> Tensor:
    """-> (N, J, 3) poses (N, J, 3) with noise on all joints, and some limbs lost.

    A lost limb is that of the middle pose, of another pose, all noise, or drawn some way to the middle; each as often.
    """

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator)

    count, joints = len(vectors), vectors.shape[1]
    noise = torch.randn(vectors.shape, generator=generator)
    shaken = vectors + NOISE * uniform(count, 1, 1) * noise
    lost = (uniform(count, len(of_limbs)) < LIMB) & (uniform(count, 1) < SPOILED)
    instead = torch.stack(
        [
            torch.zeros_like(vectors),
            vectors[torch.randperm(count, generator=generator)],
            vectors + STRONG * noise,
            vectors * uniform(count, 1, 1),
        ]
    )
    way = torch.randint(len(instead), lost.shape, generator=generator)
    for limb, its in enumerate(of_limbs):
        other = instead[way[:, limb], torch.arange(count)]
        shaken = torch.where((lost[:, limb, None] & its)[..., None].expand(count, joints, 1), other, shaken)
    return shaken
