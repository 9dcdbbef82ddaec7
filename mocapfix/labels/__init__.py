"""Labels: which marker each trajectory is.

points              trajectories without labels, cut into tracklets
requested_labels    the labels of a take without any: by a named set, a labelled take, or the set that fits
set_comparison      which marker set fits
labeller            by bodies that are fitted to key frames; body_search, posed_body, tracklets, label_overlaps
reference_labeller  by a labelled take of the same person
label_swaps, mislabelled, fragments   errors of labels in a labelled take
relabel             correct them
subject_exchanges   labels that two subjects exchanged
multi_subject       several subjects in one file
"""
