"""The tree of a skeleton's bones, and the pairs of chains in it that are alike on two sides.

Chains of two sisters are followed together: at each step children are paired whose distances from their parents and heights are
equal. What is on one side only, such as a weapon in a hand, is in no pair.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

MAX_PAIR_DIFFERENCE_SHARE = 0.03
"""difference of the lengths and of the rises of paired bones, as a share of the skeleton's height"""
MAX_PAIRED_BONES = 24
"""bones of a paired path: chains of more are hair or ropes, and their ends are no joints of a limb"""
MAX_PAIRED_SISTERS = 64
"""bones with more children carry hair or clothes; their children are not paired"""


@dataclass(frozen=True)
class PairedPaths:
    """Two paths of bones of equal lengths from two sisters outwards, to the end of what is alike."""

    first: tuple[int, ...]
    second: tuple[int, ...]


class SkeletonTree:
    """The children of each bone and what is below it.

    parents    (J,) index of each bone's parent, -1 for roots; parents come before children
    positions  (J, 3) m, world, Y up
    children   the children of each bone
    reach      (J,) length of the longest path below each bone
    top, bottom  (J,) greatest and least height of each bone and those below it
    height     from the lowest to the highest bone
    """

    def __init__(self, parents: Int[np.ndarray, " J"], positions: Float[np.ndarray, "J 3"]) -> None:
        self.parents, self.positions = parents, positions
        self.children: list[list[int]] = [[] for _ in parents]
        self.reach = np.zeros(len(parents))
        self.top, self.bottom = positions[:, 1].copy(), positions[:, 1].copy()
        self.height = float(np.ptp(positions[:, 1]))
        steps = positions - positions[parents] * (parents >= 0)[:, None]
        self._lengths: list[float] = np.linalg.norm(steps, axis=1).tolist()
        self._rises: list[float] = steps[:, 1].tolist()
        for bone in range(len(parents) - 1, -1, -1):
            parent = int(parents[bone])
            if parent >= 0:
                self.children[parent].insert(0, bone)
                self.reach[parent] = max(self.reach[parent], self.reach[bone] + self._lengths[bone])
                self.top[parent] = max(self.top[parent], self.top[bone])
                self.bottom[parent] = min(self.bottom[parent], self.bottom[bone])

    @cached_property
    def paired_paths(self) -> list[PairedPaths]:
        """The longest paths of all paired sisters, one for each end of the paired bones below them."""
        paths: list[PairedPaths] = []
        for sisters in self.children:
            if len(sisters) <= MAX_PAIRED_SISTERS:
                carriers = [bone for bone in sisters if self.children[bone]]
                for a, b in combinations(carriers, 2):
                    if self._measure_difference(a, b) is not None:
                        paths += [PairedPaths(first, second) for first, second in self._follow(a, b)]
        return paths

    def _follow(self, a: int, b: int) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
        """Return the paired paths from two bones outwards."""
        finished: list[tuple[tuple[int, ...], tuple[int, ...]]] = []
        growing = [((a,), (b,))]
        while growing:
            first, second = growing.pop()
            pairs = self._pair_children(first[-1], second[-1]) if len(first) < MAX_PAIRED_BONES else []
            growing += [((*first, left), (*second, right)) for left, right in pairs]
            if not pairs:
                finished.append((first, second))
        return finished

    def _pair_children(self, a: int, b: int) -> list[tuple[int, int]]:
        """Return the pairs of children of two bones, the most similar ones first, each child in one pair."""
        differences = [
            (difference + abs(self.reach[left] - self.reach[right]), left, right)
            for left in self.children[a][:MAX_PAIRED_SISTERS]
            for right in self.children[b][:MAX_PAIRED_SISTERS]
            if (difference := self._measure_difference(left, right)) is not None
        ]
        pairs: list[tuple[int, int]] = []
        used: set[int] = set()
        for _, left, right in sorted(differences):
            if not used & {left, right}:
                used |= {left, right}
                pairs.append((left, right))
        return pairs

    def _measure_difference(self, a: int, b: int) -> float | None:
        """Return how much two bones differ in distance from their parents and in rise, None if too much for a pair."""
        difference = max(abs(self._lengths[a] - self._lengths[b]), abs(self._rises[a] - self._rises[b]))
        return difference if difference <= MAX_PAIR_DIFFERENCE_SHARE * self.height else None
