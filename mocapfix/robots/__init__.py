"""Robots: humanoids of rigid links and motors that move like a person.

- `robot`: links, joints, limits and collision primitives, read from MJCF and URDF by MuJoCo; points and segments of its body
- `robot_map`: which links form the body, found by structure or read from YAML
- `robot_targets`: what the robot keeps of the performer
- `retarget_robot`: the joint angles of a whole take
- `robot_files`: what is written
"""
