"""The fill: estimates of missing samples, their combination, and which changes are applied.

gap_filling         the stage: each missing or faulty sample gets its most precise estimate, or a reason why it stays empty
fill_methods        the methods by name, and estimates as all of them return them
spline_fill         estimates of a take from its own trajectories; cluster_fill, from neighbours
marker_processes    Gaussian processes over all markers
gap_estimates       estimates of single gaps: neighbour_clusters, edge_interpolation, marker_processes
rigid_group_fill    estimates for props
weighted_estimates  the combination of estimates
apply_decisions     which changes are applied
computed_points     points that a program computed from markers
"""
