"""Repair before anything is filled: correct the labels, join fragments and separate the positions of moved markers.

Relabel first: a label error mimics every other fault. Repairs move samples to other labels and change nothing else. Faulty
and missing samples are left to the fill.
"""

from mocapfix.repair.moved_markers import MarkerEpochs, split_moved_markers
from mocapfix.repair.relabel import join_fragments, relabel_samples, undo_label_exchanges

__all__ = ["MarkerEpochs", "join_fragments", "relabel_samples", "split_moved_markers", "undo_label_exchanges"]
