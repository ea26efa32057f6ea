"""Demonstrations as Parquet: a long table, a row a sample."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_pbd.data.wanted import Arguments, Wanted
from torch_pbd.registry import optional

# Piece by piece: what is packed and unpacked at a time would be several times the numbers. With four times as many rows
# what the library keeps is half of the numbers more; without a buffer, in bytes, it holds all of a row group.
_ROWS, _BUFFER = 2**14, 2**20


def read(path: Path, wanted: Wanted) -> Arguments:
    """Read the format of `torch_pbd.data.load_demonstrations`."""
    with open_file(path, "parquet", f"{path.name}, as all of Parquet,") as file:
        chosen = wanted.choose({name: (name,) for name in file.schema_arrow.names}, demo="demo", time="time")
        return wanted.read_rows(chosen, read_columns(file, chosen.signals, wanted))


def open_file(path: Path, extra: str, what: str) -> Any:
    """Open Parquet file; ``extra`` and ``what`` are for the error where the library is not installed."""
    return optional("pyarrow.parquet", extra, what).ParquetFile(path, buffer_size=_BUFFER, pre_buffer=False)


def read_columns(file: Any, names: Sequence[str], wanted: Wanted) -> dict[str, NDArray[Any]]:
    """Columns of an open Parquet file by name; lists of one length are rows of a matrix."""
    metadata = file.metadata
    packed = sum(metadata.row_group(i).total_byte_size for i in range(metadata.num_row_groups))
    wanted.require(max(packed, 8.0 * metadata.num_rows * len(names)), "it")
    columns: dict[str, NDArray[Any]] = {}
    n = 0
    for batch in file.iter_batches(_ROWS, columns=list(names), use_threads=False):
        for name in names:
            values = _array(batch.column(name))
            if name not in columns:
                columns[name] = np.empty((metadata.num_rows, *values.shape[1:]), values.dtype)
            column = columns[name]
            if column.shape[1:] != values.shape[1:]:
                raise ValueError(f"column {name!r} has lists that differ in length.")
            # Whole numbers become floats where some are absent.
            columns[name] = column.astype(np.result_type(column, values), copy=False)
            columns[name][n : n + len(values)] = values
        n += batch.num_rows
    if n != metadata.num_rows:
        raise ValueError(f"it says that it has {metadata.num_rows} rows, and has {n}.")
    return {name: columns.get(name, np.empty(0)) for name in names}


def _array(column: Any) -> NDArray[Any]:
    if hasattr(column.type, "value_type") and not hasattr(column.type, "index_type"):
        values = column.flatten().to_numpy(zero_copy_only=False)
        if column.null_count or len(values) % len(column):
            raise ValueError(f"it has lists of {column.type}, which are absent in some rows or differ in length.")
        return values.reshape(len(column), -1)
    return column.to_numpy(zero_copy_only=False)
