"""Demonstrations as Parquet: a long table, a row a sample."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_pbd.data.wanted import Arguments, Wanted
from torch_pbd.extras import optional


def read(path: Path, wanted: Wanted) -> Arguments:
    """Read the format of `torch_pbd.data.load_demonstrations`."""
    parquet = optional("pyarrow.parquet", "parquet", f"{path.name}, as all of Parquet,")
    with parquet.ParquetFile(path) as file:
        chosen = wanted.choose({name: (name,) for name in file.schema_arrow.names}, demo="demo", time="time")
        return wanted.read_rows(chosen, read_columns(file, chosen.signals, wanted))


def read_columns(file: Any, names: Sequence[str], wanted: Wanted) -> dict[str, NDArray[Any]]:
    """Columns of an open Parquet file by name; lists of one length are rows of a matrix."""
    metadata = file.metadata
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    wanted.require(sum(group.total_byte_size for group in groups), "it")
    wanted.require(8.0 * metadata.num_rows * len(names), "it")
    # Piece by piece: what is packed and unpacked at a time would be several times the numbers.
    pieces: dict[str, list[NDArray[Any]]] = {name: [] for name in names}
    for batch in file.iter_batches(columns=list(names), use_threads=False):
        for name in names:
            pieces[name].append(_array(batch.column(name)))
    return {name: np.concatenate(pieces.pop(name) or [np.empty(0)]) for name in names}


def _array(column: Any) -> NDArray[Any]:
    if hasattr(column.type, "value_type") and not hasattr(column.type, "index_type"):
        values = column.flatten().to_numpy(zero_copy_only=False)
        if column.null_count or len(values) % len(column):
            raise ValueError(f"it has lists of {column.type}, which are absent in some rows or differ in length.")
        return values.reshape(len(column), -1).copy()
    return np.array(column.to_numpy(zero_copy_only=False))
