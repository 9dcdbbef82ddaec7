"""Characters: figures of other programs, and posing them like a solved body.

character         a character and the segments of its body; load_character, read_gltf, character_yaml read it
bone_mapping      which bone is which part of the body, by names or by shape (bone_geometry)
retarget_motion   pose the character like the body: body_frames, kept_positions
character_files   write its motion; fbx_export, which Blender runs
"""
