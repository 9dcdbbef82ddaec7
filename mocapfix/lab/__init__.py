"""Measurements and training: nothing here is needed to clean a take.

command, method_commands, train_command   the commands `mocapfix bench` and `mocapfix train`
baseline          accuracy, speed and memory against the committed values
sound_takes, common_task, scope_scenes     what is measured on
compared_*        mocapfix beside other methods
fuzz_*            damaged files
*_training, training_poses, recordings, settings, cards   train the priors and describe them
"""
