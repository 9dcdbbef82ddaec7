"""The person: which marker set a take has, and the bone lengths and places of markers.

library             marker sets as files, and which of them fits the labels
own_set, learning   a set learned from the take: label_words, grouped_markers, unlabelled_markers, marker_set_fit
calibration         bones and places of markers from one take
refinement          the least-squares problem of calibration; parameters, joint_calibration, body_size
person_calibration  one person from several takes
people              several persons from many takes
subject_file        subjects as YAML
props               rigid objects beside the person
"""
