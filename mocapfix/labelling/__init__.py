"""Labelling: the markers to which unlabelled trajectories belong.

Every module works on `UnlabelledPoints` (labelling.points): points (T, C, 3) in metres, Y up, NaN where missing, and for each of
them the tracklet to which it belongs. A tracklet is an unbroken piece of trajectory that shows one thing throughout. Columns do
not matter once the tracklets are known.

    points (T, C, 3)            of a take without labels, or of its unlabelled trajectories
     │  linking                 cut_columns: each column is one or several trajectories, cut at gaps and jumps
     │                          link_points: the points of a frame are in no order, and are linked from frame to frame
     ▼
    UnlabelledPoints            points, tracklet_indices (T, C), rate
     │  set_comparison          assume_marker_set: the shipped set that fits, where none is named
     │  labeller                label_points: bodies are fitted to key frames, and labels are assigned outwards from them
     │  reference_labeller      label_points_like: by a labelled take whose markers are in no known set
     │  several_people          label_people: each of several people is found, then labelled among the points of that person
     ▼
    PointLabels                 marker_indices (T, C): index of each point's marker in the marker set, -1 for none
                                confidence (T, C): probability of this label
                                subject_indices (T, C): of several persons, to whom the point belongs, -1 for none

A file's points are renamed and reordered by these in `write.labelled_files`.
"""
