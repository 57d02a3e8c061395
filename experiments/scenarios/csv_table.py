"""Tables that people bring, read with care: .csv or .csv.gz, columns in any order and case."""

from __future__ import annotations

import csv
import gzip
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from models.program import InputError


def rows_of(path: Path, required: Sequence[str], more: str = "") -> Iterator[tuple[int, dict[str, str]]]:
    """Rows of the file by the names of the columns, with their line numbers, the header being line 1.

    required  columns that must be there
    more      what the message about a missing one says of others

    Raises InputError for a file that is missing, empty or no table, and for missing columns."""
    opener = gzip.open if path.suffix == ".gz" else open
    try:
        with opener(path, "rt", newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            header = reader.fieldnames or []
            if not header:
                raise InputError(f"{path}: the file is empty; give a table with the columns {', '.join(required)}")
            if len(header) == 1 and (found := next((d for d in ";\t|" if d in header[0]), None)):
                raise InputError(
                    f"{path}: columns are separated by {found!r}; separate them by commas, decimals by points"
                )
            header = reader.fieldnames = [column.strip().lower() for column in header]
            missing = [column for column in required if column not in header]
            if missing:
                raise InputError(
                    f"{path}: no column {' and no column '.join(missing)}, the header has {', '.join(header)}; "
                    f"name the columns {', '.join(required)}{more}"
                )
            for row in reader:
                yield reader.line_num, row
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; it was looked for at {path.resolve()}") from None
    except (OSError, EOFError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: this cannot be read as a table ({error}); give a .csv or .csv.gz file") from None


def number_of(where: str, column: str, text: str | None) -> float:
    """The number in a cell. Raises InputError where there is none, or it is not finite."""
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{where}: {column} is '{text or ''}', not a number; correct the value or remove the row")
    return value
