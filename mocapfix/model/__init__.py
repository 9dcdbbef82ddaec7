"""What travels between the stages: takes, animations, bodies, faults and changes. It imports no stage.

- `take`: marker trajectories, and where their samples lie in a file
- `animation`: joints and the channels that move them
- `skeleton`: the tree of joints
- `marker_set`: which markers ride on which segment
- `subject`: a person: bone lengths and places of markers
- `motion`: the poses of a subject
- `faults`: what is wrong with samples and labels; detected, the take with its labels corrected and its faults
- `body_fit`: a calibrated subject in a take, with its motion
- `changes`: what was changed, with its reason; the filled and the decided take
- `windows`: long takes: their windows, the files of their arrays
- `stage_timer`: the seconds of each stage
- `system`: what the operating system is and has, and names of files that all systems allow
"""
