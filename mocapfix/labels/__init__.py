"""Labels: which marker each trajectory is.

- `tracklets`: trajectories without labels, linked to tracklets, and how they get labels
- `requested_labels`: the labels of a take without any: by a named set, a labelled take, or the set that fits
- `labeller`: by bodies that are fitted to key frames, and which marker set fits; body_search
- `reference_labeller`: by a labelled take of the same person
- `label_swaps`, `fragments`: errors of labels in a labelled take, and their correction
- `multi_subject`: several subjects in one file, and labels that two of them exchanged
- `label_summary`: what labelling did, for reports
"""
