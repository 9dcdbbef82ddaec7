"""Poses and camera from 2-D keypoints: MNN-IK's application to images (5.2), with HybrIK-X's camera (Eqs. 21-22).

- `keypoint_scene`: read a scene file, solve it, write the motion and its report
- `film_solver`: what detectors of keypoints found in a film, and its poses and camera
"""
