"""Files: one module for each format, reading and writing.

capture           read any format
conventions       unit, up axis and handedness of a file: the options, the file, and its person (body_evidence)
coordinates       units, axes and codes of missing points; frame_rate; animation_inference, the same for animations
c3d               c3d_parameters, c3d_blocks, c3d_events, force_plates, points
marker_table      what text tables of markers share: trc_csv, and vendor_tables of Motive, Nexus and Qualisys
bvh, asf_amc, rig, keypoint_json, npz; gltf, fbx_export (run by Blender)
changes_file      the changes of a take, with a decision for each
source_file       copies of the source in which only changed samples differ (patches); resampling
files             atomic replacement, temporary files and locks; file_content; yaml_files; shipped
"""
