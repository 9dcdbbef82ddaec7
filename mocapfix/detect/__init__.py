"""Detection of faults in marker takes, from the trajectories alone and from the solved body."""
