def trajectories(take, believed, limit=0.05):
    raise NotImplementedError
