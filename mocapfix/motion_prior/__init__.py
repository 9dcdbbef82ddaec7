"""A trained model of human motion: what moves during a gap, given the motion on either side and the joints that are seen."""
