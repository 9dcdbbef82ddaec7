"""Statistics that several stages share: Gaussian processes, Viterbi's algorithm, rigid alignment, runs of frames."""
