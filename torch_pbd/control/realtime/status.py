"""What can be wrong in a tick of the real-time controller."""

from enum import IntFlag


class TickStatus(IntFlag):
    """What was wrong in a tick; 0, which is false, where nothing was."""

    FORCE_INVALID = 1
    """The force was NaN or infinite: the median of the last good ones acts, fading."""
    FORCE_SATURATED = 2
    """The force was longer than ``force_limit`` and was shortened to it."""
    CLOCK = 4
    """``now`` did not increase, or is not finite: the robot brakes over a tick as long as they are."""
    LATE = 8
    """More than ``max_step`` after the last tick: the robot has braked meanwhile, and goes on from there."""
    SPRING_LIMITED = 16
    """The stiffness was scaled down for ``spring_limit``."""
    ACCELERATION_LIMITED = 32
    """``acceleration_limit`` acted."""
    VELOCITY_LIMITED = 64
    """``velocity_limit`` acted."""
    STOPPED = 128
    """Force or clock were bad for too long: the robot brakes and then stands still, until ``start``."""
    FORCE_RATE_LIMITED = 256
    """The force changed faster than ``force_rate_limit``."""

    def __str__(self) -> str:
        return self.name or "fine"
