"""What travels between the stages: takes, animations, bodies, faults and changes. It imports no stage.

take        marker trajectories, and where their samples lie in a file
animation   joints and the channels that move them
skeleton    the tree of joints
subject     a person: bone lengths and places of markers
motion      the poses of a subject
marker_set  which markers ride on which segment
faults      what is wrong with samples and labels
changes     what was changed, with its reason
"""
