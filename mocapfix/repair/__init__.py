"""Mending, before anything is filled: samples are put under the labels they belong to, and moved markers told apart.

Labels first, for what bears a wrong one looks like every other fault; then moved markers; what is to be replaced and what is
missing is left to the fill. Samples change places and nothing else.
"""

from mocapfix.repair.moved_markers import MarkerEpochs, split_moved_markers
from mocapfix.repair.relabel import JOINED_RELATIONS, join_fragments, relabel_samples, undo_label_exchanges

__all__ = ["JOINED_RELATIONS", "MarkerEpochs", "join_fragments", "relabel_samples", "split_moved_markers", "undo_label_exchanges"]
