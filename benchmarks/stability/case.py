"""A case of the stress suite: what goes in, what is to come out, and how the verdict is reached.

A case states its right answer before it runs: an error below a tolerance, or a refusal. Whatever comes out is judged by
that alone; a number that is not finite is never right.
"""

from __future__ import annotations

import math
import re
import signal
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from hw.base.errors import DiscoError
from pipeline.reconstruct.medium.tetrahedra import NoMedium

LONGEST_S = 120  # of a case; what takes longer hangs
LONGEST_LINE = 1500  # characters of a refusal
Find = Callable[[], float]


class Verdict(StrEnum):
    """How a case ended."""

    RIGHT = "right"
    REFUSED = "refused"
    WRONG = "silently wrong"
    CRASHED = "crashed"
    HUNG = "hung"


class Ends(StrEnum):
    """How a case is to end."""

    RIGHT = "right"
    REFUSED = "refused"
    EITHER = "right or refused"


class Hangs(BaseException):
    """A case took longer than `LONGEST_S`."""


@dataclass(frozen=True)
class Outcome:
    """error: in units of the tolerance's own kind, None where nothing came out; said: the refusal, or what broke"""

    verdict: Verdict
    error: float | None
    said: str = ""


@dataclass(frozen=True)
class Case:
    """expected: the right answer or the invariant, in words; extent: the range or the condition number that makes it
    hard; tolerance: the largest error that is right; find: makes the error, or raises; says: what a refusal has to
    contain, so that another reason is not taken for the right one; slow: takes more than a moment; rivals: the same
    question to others, by name
    """

    family: str
    name: str
    expected: str
    extent: str
    find: Find
    tolerance: float = 0.0
    ends: Ends = Ends.RIGHT
    says: str = ""
    slow: bool = False
    rivals: Mapping[str, Find] = field(default_factory=dict)

    def row(self) -> dict[str, Any]:
        """What the table shows of it."""
        start = time.perf_counter()
        own = outcome(self.find, self.tolerance)
        seconds = time.perf_counter() - start
        others = {name: outcome(find, self.tolerance) for name, find in self.rivals.items()}
        return {
            "family": self.family,
            "case": self.name,
            "extent": self.extent,
            "expected": self.expected,
            "tolerance": self.tolerance,
            "error": own.error,
            "verdict": str(own.verdict),
            "said": own.said,
            "as_expected": self.accepts(own),
            "seconds": round(seconds, 3),
            "rivals": {name: {"error": o.error, "verdict": str(o.verdict)} for name, o in others.items()},
        }

    def accepts(self, own: Outcome) -> bool:
        """Whether the case was to end like this, a refusal for this reason."""
        reason = own.verdict is not Verdict.REFUSED or self.says in own.said
        return reason and str(own.verdict) in str(self.ends).split(" or ")


class Family:
    """Cases of one kernel, in the order in which they are declared."""

    def __init__(self, name: str) -> None:
        self.name, self.cases = name, list[Case]()

    def case(
        self, name: str, expected: str, extent: str, tolerance: float = 0.0, **more: Any
    ) -> Callable[[Find], Find]:
        """Declares a case: decorates the function that finds its error. more: the other fields of `Case`."""

        def declare(find: Find) -> Find:
            self.cases.append(Case(self.name, name, expected, extent, find, tolerance, **more))
            return find

        return declare


def outcome(find: Find, tolerance: float) -> Outcome:
    """What comes of a question. Warnings of NumPy and of this program's own log do not count as refusals; the reason
    why no medium is fitted does, without a remedy: the reconstruction goes on without one and states the reason.
    """
    try:
        with warnings.catch_warnings(), limited(LONGEST_S):
            warnings.simplefilter("ignore")
            off = float(find())
    except (DiscoError, NoMedium) as refusal:
        said = re.sub(rf"{re.escape(tempfile.gettempdir())}/\w+/", "", str(refusal))
        told = "\n" not in said if isinstance(refusal, NoMedium) else said_in_one_line(refusal)
        return Outcome(Verdict.REFUSED if told else Verdict.WRONG, None, said)
    except Hangs:
        return Outcome(Verdict.HUNG, None, f"more than {LONGEST_S} s")
    except Exception as error:  # noqa: BLE001  # whatever it is, it is what the suite looks for
        return Outcome(Verdict.CRASHED, None, f"{type(error).__name__}: {' '.join(str(error).split())}"[:200])
    right = math.isfinite(off) and off <= tolerance
    return Outcome(Verdict.RIGHT if right else Verdict.WRONG, off if math.isfinite(off) else None)


def said_in_one_line(error: Exception) -> bool:
    """Whether a refusal is one line, short enough to be read, that names a remedy."""
    said = str(error)
    return "\n" not in said and len(said) < LONGEST_LINE and "Remedy: " in said


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raises: Hangs where the block takes longer, as soon as it comes back to Python."""

    def stop(*_: object) -> None:
        raise Hangs

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def relative(found: Any, exact: Any) -> float:
    """Largest relative difference of arrays or numbers; not finite where one of them is not."""
    import numpy as np

    found, exact = np.asarray(found, np.float64), np.asarray(exact, np.float64)
    if not np.isfinite(found).all():
        return math.nan
    return float(np.max(np.abs(found - exact) / np.maximum(np.abs(exact), 1e-300), initial=0.0))
