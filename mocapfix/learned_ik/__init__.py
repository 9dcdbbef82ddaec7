"""Learned inverse kinematics: one network evaluation turns a start pose and joint positions into a pose (Learnable SMPLify)."""
