"""The command line: the only modules that print, parse arguments or draw progress.

- `app`: how a command is run
- `commands`: the commands with their arguments, which are built from `mocapfix.options`; those of `batch` and `marker_sets`
- `clean`: what the commands on takes do
- `console`: the terminal: printing, progress, exit statuses
"""
