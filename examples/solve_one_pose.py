"""Solve a single pose from whatever is known of it: positions of joints, directions of bones, distances."""

from mocapfix.solve.single_pose import DirectionConstraint, DistanceConstraint, PositionConstraint, solve_pose

pose = solve_pose(
    [
        PositionConstraint("Head", (0.0, 1.6, 0.0)),
        PositionConstraint("LeftHand", (0.5, 1.4, 0.3), sd=0.02),
        DirectionConstraint("RightUpLeg", "RightLeg", (0.0, -1.0, 0.4)),
        DistanceConstraint(("LeftFoot", "RightFoot"), 0.3),
    ],
    prior="gaussian",
)
for name in ("LeftForeArm", "RightHand", "LeftFoot"):
    joint = pose.skeleton.names.index(name)
    x, y, z = pose.joint_positions[joint]
    print(f"{name}: {x:.2f}, {y:.2f}, {z:.2f} m, standard deviation {pose.joint_sd[joint] * 1e3:.0f} mm per axis")
