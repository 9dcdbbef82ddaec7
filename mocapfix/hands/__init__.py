"""Hands: the pose of the fingers of a take that has markers on them, solved after the body and without moving it.

- `hand_model`: the skeleton of a hand, its limits and its prior
- `finger_markers`: the finger markers of marker sets, and which of them a take has
- `calibrated_hand`: the hand of a person with its markers, and the terms of its poses
- `calibration`: what is the same in all frames of a take
- `solve_hands`: the motion of both hands, from first poses in closed form
- `finger_labels`: labels that fingers exchange
"""
