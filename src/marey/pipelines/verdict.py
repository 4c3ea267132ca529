"""The verdict on a result: good, usable with limits, or not usable, with what was found and what to do."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from marey.errors import MareyError

Level = Literal["good", "usable with limits", "not usable"]
"""How far a result can be used, the best first."""
LEVELS: tuple[Level, ...] = ("good", "usable with limits", "not usable")
"""All levels, the best first."""
MOST_WITHOUT_RESULT = 0.5
"""Share of frames without a result above which the rest is not usable. Chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class VerdictReason:
    """One thing that limits the use of a result: what was found, its most likely cause, and what to do."""

    level: Level
    """What the reason makes of the result, at best."""
    what: str
    """What was found and why, as sentences."""
    remedy: str = ""
    """What the user can do, as a sentence."""
    cameras: tuple[str, ...] = ()
    """The cameras that it concerns."""
    cause: str = ""
    """The kind of the cause for programs, such as "mirrored"; empty if the reason has none."""

    def __str__(self) -> str:
        return f"{self.what} {self.remedy}".strip()

    @staticmethod
    def limit(
        what: str, remedy: str = "", *, cameras: Iterable[str] = (), cause: str = ""
    ) -> "VerdictReason":
        """Return a reason that leaves a result usable with limits.

        Args:
            what: What was found and why, as sentences.
            remedy: What the user can do, as a sentence.
            cameras: The cameras that it concerns.
            cause: The kind of the cause.
        """
        return VerdictReason(level="usable with limits", what=what, remedy=remedy, cameras=tuple(cameras), cause=cause)

    @staticmethod
    def failure(
        what: str, remedy: str = "", *, cameras: Iterable[str] = (), cause: str = ""
    ) -> "VerdictReason":
        """Return a reason that makes a result not usable.

        Args:
            what: What was found and why, as sentences.
            remedy: What the user can do, as a sentence.
            cameras: The cameras that it concerns.
            cause: The kind of the cause.
        """
        return VerdictReason(level="not usable", what=what, remedy=remedy, cameras=tuple(cameras), cause=cause)


def without_result(number: int, count: int, what: str, remedy: str = "") -> tuple[VerdictReason, ...]:
    """Return the reason that follows from frames without a result; none if every frame has one.

    Args:
        number: Number of frames without a result.
        count: Number of frames that were to be measured.
        what: The predicate of the sentence about these frames.
        remedy: What the user can do, as a sentence.
    """
    if not number:
        return ()
    make = VerdictReason.failure if number > MOST_WITHOUT_RESULT * count else VerdictReason.limit
    return (make(f"{number} of {count} frames {what}.", remedy),)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The verdict of a run, which its last lines on the terminal, the head of its report, and run.json share.

    Example:
        >>> import marey
        >>> verdict = marey.load_motion("walk01").verdict
        >>> if verdict is not None and not verdict.usable:
        ...     print(verdict)
    """

    reasons: tuple[VerdictReason, ...] = ()
    """The reasons, the gravest first."""

    @staticmethod
    def of(reasons: Iterable[VerdictReason]) -> "Verdict":
        """Return the verdict that follows from some reasons."""
        return Verdict(reasons=tuple(sorted(reasons, key=lambda each: -LEVELS.index(each.level))))

    @property
    def level(self) -> Level:
        """How far the result can be used."""
        return self.reasons[0].level if self.reasons else "good"

    @property
    def usable(self) -> bool:
        """Whether the result can be used."""
        return self.level != "not usable"

    def __str__(self) -> str:
        level, reasons = self.texts()
        return "\n".join([f"Verdict: {level}", *(f"- {reason}" for reason in reasons)])

    def texts(self) -> tuple[Level, list[str]]:
        """Return the level and the sentences of each reason, as the head of a page has them."""
        return self.level, [str(reason) for reason in self.reasons]

    def as_record(self) -> dict[str, object]:
        """Return the verdict as it is in run.json."""
        return {"level": self.level, "reasons": [asdict(reason) for reason in self.reasons]}

    @staticmethod
    def from_record(record: Mapping[str, Any]) -> "Verdict | None":
        """Return the verdict in the record of a run; None if it has none."""
        found = record.get("verdict")
        if not isinstance(found, dict):
            return None
        return Verdict(
            reasons=tuple(
                VerdictReason(
                    level=each["level"], what=each["what"], remedy=each["remedy"], cameras=tuple(each["cameras"]),
                    cause=each.get("cause", ""),
                )
                for each in found["reasons"]
            )
        )


class NotUsable(MareyError):
    """A run that ended without a usable answer; its cause is known.

    Args:
        verdict: The verdict.
        report: The page with the verdict; None if there is none.

    Example:
        >>> import marey
        >>> try:
        ...     raise marey.NotUsable(marey.Verdict.of([]))
        ... except marey.MareyError as error:
        ...     print(error)
        Verdict: good
    """

    def __init__(self, verdict: Verdict, report: Path | None = None):
        self.verdict, self.report = verdict, report
        super().__init__(str(verdict) if report is None else f"{verdict}\nReport: {report}")
