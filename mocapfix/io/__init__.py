"""Files: one module for each format, reading and writing.

capture         read any format
coordinates     units, axes and handedness: the one place where files become metres with Y up
c3d, c3d_parameters, c3d_blocks, c3d_events, force_plates, points
marker_table    what text tables of markers share: trc_csv, and vendor_tables of Motive, Nexus and Qualisys
bvh, asf_amc, rig, keypoint_json, npz
gltf
source_file     copies of the source in which only changed samples differ
files           atomic replacement, temporary files and locks
yaml_files      YAML that is checked against a model
shipped         files that come with mocapfix
"""
