"""Faults of samples, found on the trajectories and against the solved body.

- `loop`: the order of the detectors of labels and samples, repeated until nothing new is found
- `gaps`, `noise`, `external_fills`, `ghosts`: on trajectories
- `body_outliers`, `marker_shifts`: against the body
- `keypoints`: points of markerless systems
- `contradictions`: takes, or learned marker sets, that contradict their body as a whole
"""
