"""Fading of the force when a device sends no poses, and its return."""

import math
from dataclasses import dataclass

from surgsim_env.haptics.device import require_positive


@dataclass(frozen=True)
class WatchdogTimes:
    """Times of the watchdog.

    Args:
        timeout: time without a fresh pose after which the force fades [s].
        fade: time from full force to none, linearly [s].
        resume: time from none to full force when poses return, linearly [s].

    Raises:
        ValueError: names the entry, its value and the rule.
    """

    timeout: float = 0.05
    fade: float = 0.1
    resume: float = 0.5

    def __post_init__(self) -> None:
        for name in ("timeout", "fade", "resume"):
            require_positive(f"watchdog.{name}", getattr(self, name), "s")


class Watchdog:
    """Counts haptic steps without a fresh pose; `share` is the factor on the force, 0 before the first pose."""

    def __init__(self, times: WatchdogTimes, haptic_step: float) -> None:
        """Count in steps of `haptic_step` [s]."""
        # Whole steps, so that rounding does not decide when the fading begins.
        self._patience = max(1, math.ceil(times.timeout / haptic_step - 1e-9))
        self._down = haptic_step / times.fade
        self._up = haptic_step / times.resume
        self.share = 0.0
        self._silent = self._patience

    @property
    def expired(self) -> bool:
        """Whether there was no fresh pose for the timeout."""
        return self._silent >= self._patience

    def step(self, fresh: bool) -> float:
        """Count one haptic step; returns the factor on the force, 0 to 1."""
        self._silent = 0 if fresh else min(self._silent + 1, self._patience)
        if self.expired:
            self.share = max(0.0, self.share - self._down)
        else:
            self.share = min(1.0, self.share + self._up)
        return self.share

    def reset(self) -> None:
        """Restart as before the first pose."""
        self.share, self._silent = 0.0, self._patience
