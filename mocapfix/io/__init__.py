"""Files: one module for each format, reading and writing.

- `capture`: read any format
- `conventions`: unit, up axis and handedness of a file: by the options, the file, and the person in it
- `coordinates`: units, codes of missing points, and axes, by what the labelled markers show of a body; frame_rate
- `c3d`, `c3d_parameters`, `c3d_blocks`, `c3d_events`, `force_plates`, `points`
- `text_tables`: TRC, plain CSV, and the tables of Motive, Nexus and Qualisys; marker_table, what they share
- `bvh`, `asf_amc`, `keypoint_json`, `npz`, `usd`, `gltf`; gltf_mesh, the meshes of a glTF
- `changes_file`: the changes of a take, with a decision for each; contact_files, contacts and events of gait
- `source_file`: what an output takes from its source; patches, in which only changed samples differ
- `files`: atomic replacement, temporary files and locks; file_content; yaml_files; shipped, files of mocapfix
"""
