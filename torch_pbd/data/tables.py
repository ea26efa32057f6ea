"""Demonstrations from and to tables of pandas, polars, pyarrow."""

from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from torch_pbd.checks import Floats
from torch_pbd.data.poses import as_columns
from torch_pbd.data.recordings import Missing
from torch_pbd.data.wanted import Wanted
from torch_pbd.exceptions import InvalidParameterError


class Tables:
    """Methods of `torch_pbd.data.Demonstrations`; abstract."""

    times: tuple[Floats, ...]

    @classmethod
    def from_frame(
        cls,
        table: Any,
        *,
        outputs: str | Sequence[str] | None = None,
        demo: str | None = None,
        time: str | None = None,
        rotation: Sequence[str] | None = None,
        angles: str | Sequence[str] | None = None,
        units: str | Sequence[str] | None = None,
        time_unit: str | None = None,
        frame: str | None = None,
        rate: float | None = None,
        missing: Missing = "raise",
    ) -> Self:
        """Demonstrations of a table of pandas, polars, pyarrow or another library that narwhals knows, a row a sample.

        Parameters
        ----------
        table : dataframe
            An index is ignored.
        outputs, demo, time, rotation, angles, units, time_unit, frame, rate, missing
            As in `torch_pbd.data.load_demonstrations`.

        Returns
        -------
        Demonstrations
            In the order in which they first appear.
        """
        import narwhals

        rows = narwhals.from_native(table, eager_only=True)
        wanted = Wanted(
            outputs=outputs,
            demo=demo,
            time=time,
            rotation=rotation,
            angles=angles,
            units=units,
            time_unit=time_unit,
            frame=frame,
            rate=rate,
            missing=missing,
        )
        chosen = wanted.choose({name: (name,) for name in rows.columns}, demo="demo", time="time")
        signals = {name: rows.get_column(name).to_numpy() for name in chosen.signals}
        return cls(**wanted.read_rows(chosen, signals))

    def to_frame(self, library: Any = "pandas") -> Any:
        """Table with columns demo, time and the outputs, a row a sample; a rotation as its quaternion, qw to qz.

        Parameters
        ----------
        library : {"pandas", "polars", "pyarrow"} or module, default="pandas"
            It must be installed.
        """
        import narwhals

        names, columns = as_columns(self)
        taken = {"demo", "time"} & set(names)
        if taken:
            raise InvalidParameterError(
                f"an output named {min(taken)!r} cannot be told from the other columns: rename it."
            )
        table = {
            "demo": np.repeat(np.arange(len(self.times)), [len(time) for time in self.times]),
            "time": np.concatenate(self.times),
            **dict(zip(names, np.concatenate(columns).T, strict=True)),
        }
        return narwhals.from_dict(table, backend=library).to_native()
