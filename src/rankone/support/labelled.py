"""What results look like as tables of pandas, as data sets of xarray, and in notebooks.

Both libraries are optional: ``pip install pandas xarray``, or ``pip install ".[io]"`` in the folder
of the project.
"""

from __future__ import annotations

import html
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from rankone.support.errors import optional_module
from rankone.support.wording import html_table, text_table

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


class Table(NamedTuple):
    """A line of summary, the heads of columns, rows of cells, and remarks below them.

    The first ``labels`` columns are aligned on the left.
    """

    summary: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    remarks: Sequence[str] = ()
    labels: int = 1


class Variables(NamedTuple):
    """Arrays with the names of their axes, and the labels along each axis."""

    arrays: Mapping[str, tuple[tuple[str, ...], Any]]
    labels: Mapping[str, Any]


class Labelled(ABC):
    """A result that prints as a table, and becomes one of pandas or xarray."""

    @abstractmethod
    def _table(self) -> Table:
        """What is printed."""

    @abstractmethod
    def _variables(self) -> Variables:
        """What the result has, with labels."""

    def __repr__(self) -> str:
        summary, header, rows, remarks, labels = self._table()
        lines = text_table(summary, header, rows, right=header[labels:]).splitlines()
        return "\n".join([lines[0], *(f"  {line}" for line in [*lines[1:], *remarks])])

    def _repr_html_(self) -> str:
        return html_of(self._table())

    def to_xarray(self) -> xr.Dataset:
        """The result with labelled axes.

        Raises
        ------
        RankoneError
            If xarray is not installed.
        """
        xarray: Any = optional_module("xarray", "labelled values need xarray", "pip install xarray")
        arrays, labels = self._variables()
        labelled: xr.Dataset = xarray.Dataset(dict(arrays), dict(labels))
        return labelled

    def to_dataframe(self) -> pd.DataFrame:
        """The result as a table, a row for each combination of labels.

        Raises
        ------
        RankoneError
            If pandas is not installed.
        """
        pandas: Any = optional_module("pandas", "tables need pandas", "pip install pandas")
        arrays, labels = self._variables()
        (axes, _), *_ = arrays.values()
        columns = {name: array for name, (own, array) in arrays.items() if own == axes}
        if not axes:
            single: pd.DataFrame = pandas.DataFrame({n: [float(x)] for n, x in columns.items()})
            return single
        index = pandas.MultiIndex.from_product([labels[axis] for axis in axes], names=axes)
        if len(axes) == 1:
            index = pandas.Index(labels[axes[0]], name=axes[0])
        rows: pd.DataFrame = pandas.DataFrame(
            {name: array.ravel() for name, array in columns.items()}, index
        )
        return rows


def html_of(table: Table) -> str:
    """A table for notebooks, with its remarks below."""
    remarks = "".join(f"<p>{html.escape(remark)}</p>" for remark in table.remarks)
    return html_table(table.summary, table.header, table.rows) + remarks
