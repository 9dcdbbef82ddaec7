"""Jobs: YAML files that name takes and the options with which they are cleaned."""
