"""Statistics that several stages share.

- `sequences`: runs of frames, evenly spaced samples, cheapest and smoothest paths, resolution
- `rigid_alignment`: rigid alignment of point clouds over a take
- `marker_distances`: distances between markers, and how badly a sample contradicts them
- `point_functions`: points as exact functions of others; point_function_search finds them
- `gaussian_process`: Gaussian processes over the frames of a take
"""
