"""One way between skeletons: people, animations, rigs of other programs, and characters.

- `character`: a figure and the segments of its body; load_character, read_gltf and character_yaml read it
- `bone_names`: which joint or bone is which part of the body, by its name; bone_geometry, by the shape of the skeleton;
  bone_mapping, for a character
- `alignment`: rotations of one skeleton as those of another with the same parts; rig, the motion on the rig of a program
- `retarget_motion`: pose a character of other proportions like a body: body_frames, kept_positions
- `character_files`: write its motion; fbx_export, which Blender runs
"""
