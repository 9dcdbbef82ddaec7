"""The command line: the only modules that print, parse arguments or draw progress."""
