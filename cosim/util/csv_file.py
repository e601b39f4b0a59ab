"""CSV files that users bring, with the numbers of their lines, for errors that name them."""

import csv
from pathlib import Path

from vcmvsp.cosim.errors import UsageError


def read_cells(path: Path) -> list[tuple[int, list[str]]]:
    """The lines that are not blank: number of each, from 1, and its cells without white space around them.

    Raises:
        UsageError: there is no such file, or it is no CSV file in UTF-8.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
    except FileNotFoundError as error:
        raise UsageError(f"{path}: there is no such file") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{path}: is not a CSV file in UTF-8 ({error})") from error
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror or error}") from error
    return [(number, cells) for number, cells in lines if any(cells)]
