"""To which of two persons each tracklet belongs, from evidence about pairs of tracklets."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import depth_first_order, minimum_spanning_tree

# Largest evidence of one pair of tracklets: the frames of a long one are not independent.
MAX_PAIR_EVIDENCE = 20.0
# Weight of a second with a person's label, in the unit of the evidence.
LABEL_WEIGHT_PER_S = 0.02
MAX_ASSIGNMENT_PASSES = 20
# Smallest agreement with the evidence that an exchange of sides must gain: less is rounding.
MIN_AGREEMENT_GAIN = 1e-9


@dataclass(frozen=True)
class TrackletRelations:
    """Evidence about R pairs of tracklets.

    Attributes:
        pairs: Indices (R, 2) of tracklets, the smaller first.
        evidence: Positive for the same person, negative for two persons.
    """

    pairs: Int[np.ndarray, "R 2"]
    evidence: Float[np.ndarray, " R"]

    @staticmethod
    def collect(parts: "Sequence[TrackletRelations]") -> "TrackletRelations":
        """Return the relations with the evidence of all parts on the same pair added up."""
        if not parts:
            return TrackletRelations(np.zeros((0, 2), int), np.zeros(0))
        pairs, index = np.unique(np.concatenate([part.pairs for part in parts]), axis=0, return_inverse=True)
        return TrackletRelations(pairs, np.bincount(index.ravel(), np.concatenate([part.evidence for part in parts]), len(pairs)))

    @staticmethod
    def sum_runs(
        one: Int[np.ndarray, " F"], two: Int[np.ndarray, " F"], evidence: Float[np.ndarray, " F"]
    ) -> "TrackletRelations":
        """Return the relations of F frames with tracklets `one` and `two` (-1 for none), one for each run of the same pair."""
        is_known = (one >= 0) & (two >= 0) & (one != two) & ~np.isnan(evidence)
        pairs, known = np.sort(np.stack([one[is_known], two[is_known]], 1), axis=1), evidence[is_known]
        starts = np.flatnonzero(np.r_[True, (np.diff(pairs, axis=0) != 0).any(1)][: len(pairs)])
        return TrackletRelations(pairs[starts], np.add.reduceat(known, starts) if len(starts) else known)

    @property
    def limited_evidence(self) -> Float[np.ndarray, " R"]:
        """The evidence, no larger than frames that depend on each other allow."""
        return np.clip(self.evidence, -MAX_PAIR_EVIDENCE, MAX_PAIR_EVIDENCE)


def assign_persons(relations: TrackletRelations, label_s: Float[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
    """Assign each tracklet to person 0 or 1.

    Tracklets are joined by the strongest evidence first, which makes trees of them. Parts of a tree, and then single tracklets,
    are exchanged between the persons as long as this agrees better with all evidence. Each tree is assigned by its labels.

    Args:
        relations: the evidence about pairs of tracklets.
        label_s: how many seconds longer each tracklet has labels of person 0 than of person 1.
    """
    evidence, count = relations.limited_evidence, len(label_s)
    weights = csr_array((MAX_PAIR_EVIDENCE + 1 - np.abs(evidence), tuple(relations.pairs.T)), (count, count))
    signs = csr_array((np.where(evidence > 0, 1.0, -1.0), tuple(relations.pairs.T)), (count, count))
    signs, tree = signs + signs.T, minimum_spanning_tree(weights)
    side, is_reached = np.ones(count), np.zeros(count, bool)
    for root in range(count):
        if is_reached[root]:
            continue
        order, parents = depth_first_order(tree, root, directed=False)
        is_reached[order] = True
        for n in order[1:]:
            side[n] = side[parents[n]] * signs[parents[n], n]
        if len(order) > 1:
            _exchange_subtrees(side, order, parents, relations)
        if side[order] @ label_s[order] < 0:
            side[order] *= -1
    return np.where(_agree(side.astype(int), relations, label_s) > 0, 0, 1)


def _exchange_subtrees(
    side: Float[np.ndarray, " N"], order: Int[np.ndarray, " n"], parents: Int[np.ndarray, " N"], relations: TrackletRelations
) -> None:
    """Turn the sides of parts of a tree in place, as long as this agrees better with the evidence.

    Args:
        side: 1 or -1 for each tracklet.
        order: the tracklets of the tree in depth-first order, so that each subtree is an interval of it.
        parents: the parent of each tracklet in the tree.
        relations: the evidence.
    """
    position = np.full(len(side), -1)
    position[order] = np.arange(len(order))
    stop = np.arange(1, len(order) + 1)  # of each subtree
    for i in range(len(order) - 1, 0, -1):
        stop[position[parents[order[i]]]] = max(stop[position[parents[order[i]]]], stop[i])
    is_in_tree = position[relations.pairs[:, 0]] >= 0
    (a, b), evidence = relations.pairs[is_in_tree].T, relations.limited_evidence[is_in_tree]
    first, second = position[a], position[b]
    ancestor = _find_common_ancestors(
        np.r_[0, position[parents[order[1:]]]], np.minimum(first, second), np.maximum(first, second)
    )
    for _ in range(MAX_ASSIGNMENT_PASSES):
        agreement = evidence * side[a] * side[b]
        ends, apexes = (
            np.bincount(at, weights, len(order))
            for at, weights in ((np.r_[first, second], np.r_[agreement, agreement]), (ancestor, agreement))
        )
        total = np.r_[0.0, np.cumsum(ends - 2 * apexes)]
        across = (total[stop] - total[:-1])[1:]  # of the pairs with exactly one end in each subtree
        worst = int(across.argmin())
        if across[worst] > -MIN_AGREEMENT_GAIN:
            return
        side[order[worst + 1 : stop[worst + 1]]] *= -1


def _find_common_ancestors(
    parent: Int[np.ndarray, " n"], first: Int[np.ndarray, " P"], last: Int[np.ndarray, " P"]
) -> Int[np.ndarray, " P"]:
    """Return the lowest common ancestors of the nodes `first` < `last` of a tree whose nodes are numbered in depth-first order.

    It is the first of the parents of all nodes behind `first` up to `last`; tables have the minima over 1, 2, 4, ... nodes.
    """
    tables = [parent]
    while 2 ** len(tables) < len(parent):
        half = 2 ** (len(tables) - 1)
        tables.append(np.minimum(tables[-1], np.r_[tables[-1][half:], np.full(half, len(parent))]))
    level = np.floor(np.log2(np.maximum(last - first, 1))).astype(int)
    table = np.stack(tables)
    return np.minimum(table[level, first + 1], table[level, last + 1 - 2**level])


def _agree(side: Int[np.ndarray, " N"], relations: TrackletRelations, label_s: np.ndarray) -> Int[np.ndarray, " N"]:
    """Return the sides (1 or -1) after single tracklets changed theirs where this agrees better with the others."""
    side = side.copy()
    neighbours = _list_neighbours(len(side), relations)
    for _ in range(MAX_ASSIGNMENT_PASSES):
        is_changed = False
        for n, (others, evidence) in enumerate(neighbours):
            pull = float((evidence * side[others]).sum()) + LABEL_WEIGHT_PER_S * label_s[n]
            if pull * side[n] < 0:
                side[n] *= -1
                is_changed = True
        if not is_changed:
            break
    return side


def compute_support(
    relations: TrackletRelations, label_s: Float[np.ndarray, " N"], person: Int[np.ndarray, " N"]
) -> Float[np.ndarray, " N"]:
    """Compute the evidence for each tracklet's person, given those of the others, over that for the other person."""
    side = np.where(person == 0, 1, -1)
    pull = [float((evidence * side[others]).sum()) for others, evidence in _list_neighbours(len(side), relations)]
    return side * (np.array(pull) + LABEL_WEIGHT_PER_S * label_s)


def _list_neighbours(count: int, relations: TrackletRelations) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the other tracklets and the evidence about them for each tracklet."""
    both = np.concatenate([relations.pairs, relations.pairs[:, ::-1]])
    evidence = np.concatenate([relations.limited_evidence] * 2)
    order = np.argsort(both[:, 0], kind="stable")
    starts = np.searchsorted(both[order, 0], np.arange(count + 1))
    return [(both[order[a:b], 1], evidence[order[a:b]]) for a, b in pairwise(starts)]
