"""How a solver ended: an outcome with its cause and its remedy, which callers act on."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from enum import StrEnum

from hw.base.errors import DiscoError


class Outcome(StrEnum):
    """How an iteration, or the solution of a system, ended."""

    CONVERGED = "converged"
    STOPPED = "stopped"
    SINGULAR = "singular"
    OUT_OF_RANGE = "out of range"


CAUSE = {
    Outcome.CONVERGED: "converged",
    Outcome.STOPPED: "was stopped after {steps} steps, before it converged",
    Outcome.SINGULAR: "has measurements that leave unknowns free",
    Outcome.OUT_OF_RANGE: "meets values that are not finite",
}
REMEDY = {
    Outcome.CONVERGED: "none is needed",
    Outcome.STOPPED: "measure more, or with less noise; start nearer to the truth",
    Outcome.SINGULAR: "measure more, or more varied",
    Outcome.OUT_OF_RANGE: "check what was measured, and the nominal rig",
}


class Unsolved(DiscoError):
    """A solver found nothing that can be used. outcome: why"""

    def __init__(self, what: str, outcome: Outcome, steps: int = 0, remedy: str | None = None) -> None:
        self.outcome = outcome
        cause = CAUSE[outcome].format(steps=steps)
        super().__init__(f"{what} {cause}. Remedy: {remedy or REMEDY[outcome]}")


@dataclass(frozen=True)
class Ended:
    """How it ended, and after how many steps."""

    outcome: Outcome = Outcome.CONVERGED
    steps: int = 0

    @property
    def converged(self) -> bool:
        """Whether what was found can be used as it is."""
        return self.outcome is Outcome.CONVERGED

    def require(self, what: str, remedy: str | None = None) -> None:
        """Raises: Unsolved, about `what`, unless it converged."""
        if not self.converged:
            raise Unsolved(what, self.outcome, self.steps, remedy)

    def warn(self, log: logging.Logger, what: str) -> None:
        """A line in the log about `what`, unless it converged: where what was found still serves."""
        if not self.converged:
            log.warning("%s %s", what, CAUSE[self.outcome].format(steps=self.steps))


CONVERGED = Ended()
