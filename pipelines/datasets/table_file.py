"""A user's table as it is in its file: CSV, whose columns are numbers where all of their values are, or Parquet."""

import csv
import gzip
import io
import itertools
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pandas as pd

from pipelines.errors import ConfigError

PARQUET = (".parquet", ".pq")
MISSING = ("", "?")
MISSING_NUMBERS = ("NA", "N/A", "NaN", "nan", "NULL", "null", "None")  # of a text it may be a category
DECIMAL = r"[+-]?\d*,?\d+([eE][+-]?\d+)?"
WHOLE = r"[+-]?\d+"
THOUSANDS = r"[+-]?[1-9]\d{0,2}(,\d{3})+"
N_LINES = 50  # by which the separator is found


def read_table(path: str | Path, texts: Collection[str] = ()) -> pd.DataFrame:
    """Return the rows of a file; of CSV the columns `texts` stay as they are written.

    Args:
        path: CSV with a header, its columns separated by commas, semicolons or tabs, or Parquet.
        texts: columns that hold categories, whose numbers are no numbers.

    Raises:
        ConfigError: there is no such file, or it is none; or a number may have a thousands separator.
    """
    path = Path(path)
    try:
        if path.suffix.lower() in PARQUET:
            frame = pd.read_parquet(path)
        else:
            separator = _separator(path)
            frame = pd.read_csv(
                path, sep=separator, dtype=str, keep_default_na=False, na_values=list(MISSING), encoding="utf-8-sig"
            )
            for name in frame.columns.difference(list(texts), sort=False):
                frame[name] = _typed(frame[name], path, has_commas=separator != ",")
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: there is no such file") from error
    except ImportError as error:
        raise ConfigError(f"{path}: Parquet is read by pyarrow: pip install 'otr[parquet]'") from error
    except ConfigError:
        raise
    except (ValueError, OSError, csv.Error) as error:  # among them pandas' own, and those of text that is no UTF-8
        raise ConfigError(f"{path} cannot be read as a table with a header: {error}") from error
    frame.columns = frame.columns.map(str)
    return frame


def _separator(path: Path) -> str:
    """Return the separator with which the first lines have equally many columns, and most of them."""
    is_packed, encoding = path.suffix.lower() == ".gz", "utf-8-sig"
    with gzip.open(path, "rt", encoding=encoding) if is_packed else path.open(encoding=encoding) as file:
        lines = list(itertools.islice(file, N_LINES + 1))

    def fitness(separator: str) -> tuple[bool, int]:
        rows = [row for row in csv.reader(io.StringIO("".join(lines)), delimiter=separator) if row]
        rows = rows[:-1] if len(lines) > N_LINES else rows  # the last may be cut within quotes
        widths = [len(row) for row in rows]
        return len(set(widths)) == 1 and widths[0] > 1, max(widths[:1], default=0)

    return max("\t;,", key=fitness)


def _typed(column: pd.Series, path: Path, *, has_commas: bool) -> pd.Series:
    """Return a column of texts as numbers or truth values where all are such, and otherwise as it is."""
    known = column.dropna()
    known = known[~known.isin(MISSING_NUMBERS)]
    if known.empty:
        return pd.Series(np.nan, column.index)
    if len(known) == len(column) and known.str.lower().isin(("true", "false")).all():
        return known.str.lower() == "true"
    grouped = known[known.str.fullmatch(THOUSANDS)]
    if len(grouped) and (known.str.fullmatch(THOUSANDS) | known.str.fullmatch(WHOLE)).all():
        number = grouped.iloc[0]
        raise ConfigError(
            f"{path}: column {column.name!r} has {number}, a thousand or a decimal: write it as "
            f"{number.replace(',', '')} or {number.replace(',', '.')}"
        )
    if has_commas and known.str.fullmatch(DECIMAL).all():
        known = known.str.replace(",", ".")
    numbers = pd.to_numeric(known, errors="coerce")
    if numbers.isna().any():
        return column
    exact = numbers if pd.api.types.is_integer_dtype(numbers) else known.astype(np.float64)
    return exact if len(known) == len(column) else exact.astype(np.float64).reindex(column.index)
