"""The person: which marker set a take has, and the bone lengths and places of markers.

- `library`: marker sets, landmarks and subjects as files, and which set fits the labels
- `learning`: a set learned from the take: label_words, unlabelled_markers, marker_set_fit
- `average_body`: the average body at the size of a take, and its coarse poses
- `calibration`: bones and places of markers from one take; refinement
- `person_calibration`: one person from several takes
- `people`: several persons from many takes
- `props`: rigid objects beside the person
"""
