"""Demonstrations as MATLAB's .mat: cells demos{k} or data{k}, as of the letters, LASA and ds-opt."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.data.recordings import preview
from torch_pbd.data.wanted import Arguments, Wanted, column_names, numeric
from torch_pbd.registry import optional

_DEEPEST = 8  # cells in structs in cells


def read(path: Path, wanted: Wanted, variable: str | None = None) -> Arguments:
    """Read the format of `torch_pbd.data.load_demonstrations`, which describes the options."""
    checks.text(variable, "variable", optional=True)
    with path.open("rb") as file:
        is_hdf5 = file.read(10) == b"MATLAB 7.3"
    if is_hdf5:
        content = _read_hdf5(path, wanted)
    else:
        from scipy.io import loadmat, whosmat  # here: other formats do without

        sizes = [8.0 * float(np.prod(shape, dtype=float)) for _, shape, kind in whosmat(path) if kind != "cell"]
        wanted.require(sum(sizes), "it")
        content = {name: value for name, value in loadmat(path, simplify_cells=True).items() if name[0] != "_"}
    name = variable or next((name for name in ("demos", "data") if name in content), None)
    if name not in content:
        what = f"variable {variable!r}" if variable else "variables demos or data"
        raise ValueError(f"it has no {what}, but {preview([*content])}: say by variable= which is the recordings.")
    cells = content[name]
    if isinstance(cells, np.ndarray) and cells.dtype == object:  # as scipy has cells
        cells = [*cells.flat]
    cells = cells if isinstance(cells, list) else [cells]
    recordings = [_signals(cell, f"{name}{{{k}}}", content.get("dt")) for k, cell in enumerate(cells, 1)]
    columns = {key: column_names(key, value.shape) for key, value in (recordings or [{}])[0].items()}
    chosen = wanted.choose(columns, time="t" if "t" in columns else None, outputs="pos")
    return wanted.read_each(chosen, recordings)


def _signals(cell: Any, place: str, step: Any) -> dict[str, NDArray[Any]]:
    """Signals (T,) or (T, d) of one recording: of a struct of matrices (d, T), or of a matrix of them."""
    if not isinstance(cell, Mapping):
        matrix = np.asarray(cell)
        if matrix.ndim != 2:
            raise ValueError(f"{place} is a {type(cell).__name__}, must be a struct with pos, or a matrix.")
        matrix = matrix.T if matrix.shape[0] <= matrix.shape[1] else matrix
        position, velocity = np.array_split(matrix, 2, axis=1)
        if is_both := place.startswith("data{") and velocity.shape == position.shape:
            # ds-opt stacks positions on velocities, whose cosine with the changes of positions is .9996 or more in its
            # own files; halves of other recordings, of which one is no velocity, have .63 at most.
            change = np.gradient(position, axis=0)
            is_both = bool(np.vdot(change, velocity) > 0.9 * np.linalg.norm(change) * np.linalg.norm(velocity))
        cell = {"pos": position, "vel": velocity} if is_both else {"pos": matrix}
    arrays = numeric({key: np.asarray(value) for key, value in cell.items() if not isinstance(value, Mapping | list)})
    arrays = {key: array for key, array in arrays.items() if array.size > 1}
    if not arrays:
        raise ValueError(f"{place} has no matrices, but {preview([*cell])}.")
    # Time runs along the axis that all share: that of t, or the longer one of the positions.
    n = arrays["t"].size if "t" in arrays else max(arrays.get("pos", next(iter(arrays.values()))).shape)
    signals = {
        key: array.reshape(-1) if array.size == n else array if array.shape[0] == n else array.T
        for key, array in arrays.items()
        if n in array.shape
    }
    step = np.asarray(cell.get("dt", step))
    if "t" not in signals and step.size == 1 and step.dtype.kind in "iuf":
        signals["t"] = np.arange(n) * float(step.item())
    return signals


def _read_hdf5(path: Path, wanted: Wanted) -> dict[str, Any]:
    h5py = optional("h5py", "hdf5", f"{path.name}, as all of MATLAB's version 7.3,")
    total = 0.0
    with h5py.File(path, "r") as file:

        def plain(value: Any, depth: int = 0) -> Any:
            nonlocal total
            if depth > _DEEPEST:
                raise ValueError(f"its structs and cells lie in each other more than {_DEEPEST} deep.")
            if isinstance(value, h5py.Group):
                fields = {key: plain(value[key], depth + 1) for key in value}
                # An array of structs is stored as lists, one for each field.
                lists = [entry for entry in fields.values() if isinstance(entry, list)]
                if lists and len(lists) == len(fields) and len(set(map(len, lists))) == 1:
                    return [dict(zip(fields, entries, strict=True)) for entries in zip(*lists, strict=True)]
                return fields
            total += value.nbytes
            wanted.require(total, "it")
            if value.dtype == h5py.ref_dtype:
                return [plain(file[reference], depth + 1) for reference in value[()].reshape(-1)]
            return value[()].T  # MATLAB's order is that of columns

        return {key: plain(file[key]) for key in file if not key.startswith("#")}
