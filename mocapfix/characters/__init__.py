"""Characters: the motion of the solved body on another skeleton.

character         a character; character_choice, read_gltf, gltf_nodes, character_yaml read it
bone_mapping      which bone is which part of the body, by names or by shape; rest_poses
retarget_motion   pose the character like the body: body_frames, segment_motion, pose_segments
kept_hands, kept_positions   places of hands and feet
"""
