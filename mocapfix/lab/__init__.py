"""Measurements and training: nothing here is needed to clean a take.

- `command`, `train_command`, `results`: the commands `mocapfix bench` and `mocapfix train`, and how results are printed
- `baseline`: accuracy, speed and memory against the committed values
- `sound_takes`, `common_task`: what is measured on
- `compared_*`: mocapfix beside other methods
- `fuzz_*`: damaged files
- `*_training`, `training_poses`, `recordings`, `settings`, `cards`: train the priors and describe them
"""
