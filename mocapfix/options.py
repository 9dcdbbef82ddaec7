"""What may be chosen about the solve."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SolveOptions:
    """How the solve weighs what it is told."""

    marker_sd_m: float = 0.010
    """how far a sound marker lies from its place on the body, metres (standard deviation per axis)"""
    robust_scales_m: tuple[float, ...] = (0.1, 0.05)
    """Geman-McClure scales, metres, one after the other: a marker farther off than the last hardly counts"""
    pose_persistence_s: float = 1.0
    """how long a pose goes on, seconds: the prior speaks once in that time, not anew in every frame"""
    limit_sd_rad: float = 0.1
    """how far a joint turns beyond people's limits, radians (standard deviation), said as often as the prior is"""
    gap_border_s: float = 0.05
    """how long beside a gap a marker is not listened to, seconds; see `listening.beside_gaps`"""
    rotation_jitter_rad: float = 0.01
    """how much a joint trembles from frame to frame beyond its motion, radians"""
    root_jitter_m: float = 0.001
    """how much the root does, metres"""
    rotation_tracking_sd_rad: float = 0.1
    """how far a joint strays from its smooth course, radians"""
    root_tracking_sd_m: float = 0.03
    """how far the root strays from its smooth course, metres"""
    prior_scale: float = 1.0
    """times a trained model's standard deviations: with 2 it is believed half as much"""
