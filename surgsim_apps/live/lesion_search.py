"""A game on the live page: a hidden lesion, a guess, and a score."""

from dataclasses import dataclass
from datetime import date

from msdm_core.material import Lesion
from msdm_core.mesh import FloatArray
from surgsim_env.scene import Anatomy

# Points off for each millimetre of error, for each press, and for a force at the hard limit, of which forces up to the
# soft limit cost nothing.
MM_COST, PRESS_COST, FORCE_COST = 4.0, 1.0, 50.0
# Forces at which a press begins and ends [N].
PRESS_BEGINS, PRESS_ENDS = 0.03, 0.01
# Between the seeds of the searches of a day: more than there are days.
SEED_STEP = 10_000_000


@dataclass(frozen=True)
class Guess:
    """A marked place: distance from the lesion along the surface [m], presses, peak force [N], points."""

    error: float
    presses: int
    force_peak: float
    points: int

    @property
    def text(self) -> str:
        """Error, effort and points in a line."""
        effort = f"{self.presses} presses, at most {self.force_peak:.2f} N"
        return f"{1e3 * self.error:.1f} mm from the lesion, {effort}: {self.points} points of 100"


class LesionSearch:
    """Searches in turn on one organ; the first has the lesion of the day, the same for everybody.

    Fields:
        seed: of the lesion
        open: True from `begin` to `mark`
        presses: since `begin`
        guess: of the last search; None during one, and before the first
    """

    def __init__(self, anatomy: Anatomy, today: date | None = None) -> None:
        """Before the first search."""
        self._anatomy = anatomy
        self.seed = (today or date.today()).toordinal() - SEED_STEP
        self.guess: Guess | None = None
        self.open = False

    def begin(self) -> None:
        """Begin a search."""
        self.seed += SEED_STEP
        self.open, self.guess = True, None
        self.presses, self._peak, self._pressing = 0, 0.0, False
        self._tip: FloatArray | None = None

    def feel(self, tip: FloatArray, force: float) -> None:
        """Take the tip's centre [m], (3,), and the force's size [N] of a reading."""
        self._peak = max(self._peak, force)
        pressed, self._pressing = self._pressing, force > (PRESS_ENDS if self._pressing else PRESS_BEGINS)
        self.presses += self._pressing and not pressed
        if self._pressing:
            self._tip = tip

    def mark(self, lesions: list[Lesion]) -> None:
        """End the search; the place of the last press is the guess. Without a press it goes on."""
        if self._tip is None:
            return
        place, _ = self._anatomy.face.project(self._tip)
        self.guess = self.rated(place, self.presses, self._peak, lesions)
        self.open = False

    def rated(self, place: FloatArray, presses: int, force_peak: float, lesions: list[Lesion]) -> Guess:
        """The guess of a place on the surface [m], (3,), after presses with a peak force [N]."""
        anatomy, limits = self._anatomy, self._anatomy.scene.limits
        truths = [anatomy.face.project(lesion.centre)[0] for lesion in lesions if lesion.centre is not None]
        error = min(float(anatomy.along_surface(truth, place[None])[0]) for truth in truths)
        excess = (force_peak - limits.soft_force) / (limits.hard_force - limits.soft_force)
        cost = MM_COST * 1e3 * error + PRESS_COST * presses + FORCE_COST * max(0.0, excess)
        return Guess(error, presses, force_peak, max(0, round(100.0 - cost)))
