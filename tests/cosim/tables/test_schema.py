from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from vcmvsp.cosim.tables.columns import name_column
from vcmvsp.cosim.tables.schema import TableFile, read_table


def test_a_table_with_a_text_that_is_not_utf8_is_refused(tmp_path: Path) -> None:
    whole = tmp_path / "whole.parquet"
    pq.write_table(pa.table({"sender": name_column(["car1"], np.zeros(3, np.int32))}), whole, compression="none")
    damaged = tmp_path / "damaged.parquet"
    damaged.write_bytes(whole.read_bytes().replace(b"car1", b"c\xder1"))
    assert read_table(whole)["sender"].to_pylist() == ["car1"] * 3
    with pytest.raises(ValueError, match="UTF8"):
        read_table(damaged)
    with pytest.raises(ValueError, match="UTF8"):
        list(TableFile(damaged).blocks())
