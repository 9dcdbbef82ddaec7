"""One way between skeletons: people, animations, rigs of other programs, and characters.

- `character`: a figure and the segments of its body; load_character, read_gltf and character_yaml read it
- `rest_poses`: which pose of its file is its rest pose
- `bone_mapping`: which joint or bone is which part of a body, by its name or by the shape of the skeleton (bone_geometry)
- `alignment`: rotations of one skeleton as those of another with the same parts: animations, and rigs of programs
- `retarget_motion`: pose a character of other proportions like a body: body_frames, kept_positions, limb_fit
- `character_files`: write its motion; clips, what engines need; fbx, and fbx_export, which Blender runs
"""
