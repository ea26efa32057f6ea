"""What a group of comparisons finds: rows with all the numbers behind them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from speed.timing import median, ratios

Bar = tuple[Literal[">=", "<="], float]


@dataclass(frozen=True)
class Plan:
    """How much to run."""

    n_repetitions: int = 5
    quick: bool = False
    """Small sizes, to see that everything runs; its numbers mean nothing."""
    seed: int = 0
    data: Path | None = None
    """Folder of recorded demonstrations."""

    def size(self, full: int, small: int) -> int:
        """A size of this run."""
        return small if self.quick else full


@dataclass(frozen=True)
class Row:
    """One comparison, or one measurement with a bar."""

    what: str
    ours: list[float]
    unit: str = "s"
    other: list[float] | None = None
    """What the ratio is of, to ours; without it the bar is of ours."""
    other_name: str = ""
    bar: Bar | None = None
    note: str = ""

    @property
    def values(self) -> list[float]:
        """What is held against the bar, repetition by repetition."""
        return self.ours if self.other is None else ratios(self.other, self.ours)

    @property
    def held(self) -> bool | None:
        """Whether the median is on the right side of the bar."""
        if self.bar is None:
            return None
        sense, limit = self.bar
        value = median(self.values)
        return value >= limit if sense == ">=" else value <= limit


@dataclass(frozen=True)
class Growth:
    """Times of one kind of work at some sizes."""

    what: str
    axis: str
    """The size and its unit, if it has one."""
    sizes: list[int]
    seconds: list[list[float]]
    exponent: float


@dataclass
class Findings:
    """All that a group found."""

    group: str
    rows: list[Row] = field(default_factory=list)
    growth: list[Growth] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    """What could not be compared, and why."""

    def try_peer(self, package: str, comparison: Callable[[], object]) -> None:
        """Run a comparison with a package, or note that it is not installed."""
        try:
            comparison()
        except ModuleNotFoundError as error:
            if error.name is None or error.name.partition(".")[0] != package:
                raise
            note = f"{package} is not installed: its comparisons are left out"
            if note not in self.left_out:
                self.left_out.append(note)
