"""Poses and camera from 2-D keypoints: MNN-IK's application to images (5.2), with HybrIK-X's camera (Eqs. 21-22)."""
