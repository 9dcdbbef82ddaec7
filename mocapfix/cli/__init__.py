"""The command line: the only modules that print, parse arguments or draw progress.

- `app`: the commands, and the shorter ones of them
- `arguments`: what several commands share, and the arguments that are built from `mocapfix.options`
- `console`: the terminal: printing, progress, exit statuses
- `clean`, `batch`, `marker_sets`: a module for each of the larger commands
"""
