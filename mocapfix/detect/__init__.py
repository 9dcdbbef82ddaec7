"""Detection of faults in marker takes: in labels first, then in samples."""
