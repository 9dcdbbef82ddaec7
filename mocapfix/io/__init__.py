"""Files: one module for each format, reading and writing.

capture         read any format
coordinates     units, axes and handedness: the one place where files become metres with Y up
c3d, c3d_writer, points, force_plates
marker_table    what TRC, Motive, Nexus, Qualisys and plain CSV share; trc, motive, nexus, qualisys, plain_csv
bvh, amc, asf, rig, keypoint_json, npz
gltf, glb, fbx, character_files
source_file     copies of the source in which only changed samples differ
output_formats  which files a cleaning writes
files           atomic replacement, temporary files and locks
yaml_files      YAML that is checked against a model
shipped         files that come with mocapfix
"""
