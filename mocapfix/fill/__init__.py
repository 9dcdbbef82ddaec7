"""The fill: estimates of missing samples, and their weights.

- `gap_filling`: the stage: each missing or faulty sample gets its estimate, or a reason why it stays empty
- `gap_estimates`: which estimators a gap has, and the weight of each
- `gap_windows`: a gap, the stretches that imitate it, and estimates of it, as all estimators take and return them
- `edge_interpolation`, `neighbour_clusters`, `body_fill`, `rigid_group_fill`, `marker_processes`: the estimators
"""
