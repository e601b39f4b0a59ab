"""The cache of machine code, and the choice between interpreted and compiled code."""

import threading
import types
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from vcmvsp.cosim.compiled import machine_code
from vcmvsp.cosim.compiled.machine_code import LOAD_S, Block, Core


class Numbers(NamedTuple):
    rows: tuple[Any, ...]
    table: Any
    factor: float


def numbers(count: int = 4) -> Numbers:
    rows = np.arange(2.0 * count).reshape(2, count)
    return Numbers(tuple(rows), np.zeros((2, count), np.int64), 0.5)


SOURCE = """
from math import sin

def run(a, b, number):
    for k in range(len(a.rows[0])):
        a.rows[1][k] += b.factor * sin(a.rows[0][k])
        a.table[1][k] = number + k
    return number * len(a.rows[0])
"""


@pytest.fixture
def module(tmp_path: Path) -> types.ModuleType:
    made = types.ModuleType("made")
    path = tmp_path / "made.py"
    path.write_text(SOURCE, "utf-8")
    made.__file__ = str(path)
    exec(compile(SOURCE, str(path), "exec"), vars(made))
    return made


def test_compilation_can_be_turned_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VCMVSP_COMPILED", "0")
    assert not machine_code.available()


def test_code_is_kept_whole_or_not_at_all(tmp_path: Path) -> None:
    path, code = tmp_path / "folder" / "it.code", bytes(range(256)) * 100
    assert machine_code._read_code(path) is None
    machine_code._write_code(path, code)
    assert machine_code._read_code(path) == code
    assert [each.name for each in path.parent.iterdir()] == ["it.code"]
    path.write_bytes(path.read_bytes()[:-1])
    assert machine_code._read_code(path) is None
    machine_code._write_code(path / "not a folder", code)  # no error: runs without cache


def test_processes_that_need_the_same_code_at_once_compile_it_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, module: types.ModuleType
) -> None:
    made, program = [], ((module,), Block(numbers()).layout, Block(numbers()).layout)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    missed = threading.Barrier(4)  # locks of files are between threads, too
    locked = machine_code._locked

    def all_at_once(path: Path) -> Any:
        missed.wait()
        return locked(path)

    def make(program: Any) -> bytes:
        made.append(program)
        return b"code"

    monkeypatch.setattr(machine_code, "_locked", all_at_once)
    monkeypatch.setattr(machine_code, "_compile", make)
    with ThreadPoolExecutor(4) as pool:
        assert [*pool.map(machine_code._code, [program] * 4)] == [b"code"] * 4
    assert made == [program]


def test_arrays_must_be_contiguous() -> None:
    with pytest.raises(ValueError, match="table"):
        Block(numbers()._replace(table=np.zeros((4, 4))[:, :2]))


@pytest.mark.slow
def test_much_work_is_compiled_once_and_cached_code_is_loaded_for_less(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, module: types.ModuleType
) -> None:
    monkeypatch.setenv("VCMVSP_COMPILED", "1")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    core = Core((module,), numbers(), numbers())
    interpreted = core.chosen(0.5, compile_for_s=1.0)
    assert not core.is_cached
    assert not core.is_loaded
    compiled = core.chosen(0.5, compile_for_s=1.0)  # together with the work before: the cost of compiling
    assert core.is_cached
    assert core.is_loaded
    assert type(core.chosen(0.0, compile_for_s=1.0)) is type(compiled)  # already loaded
    monkeypatch.setattr(machine_code, "_loaded", {})
    assert type(core.chosen(0.0, compile_for_s=1.0)) is type(interpreted)
    assert not core.is_loaded
    ways = [type(Core((module,), numbers(), numbers()).chosen(0.4 * LOAD_S, compile_for_s=1.0)) for _ in range(3)]
    assert ways == [type(interpreted), type(interpreted), type(compiled)]  # small calls: their sum is worth the loading

    for count in (4, 7):
        one, other = numbers(count), numbers(count)
        assert interpreted(one, numbers(count), 3) == compiled(other, numbers(count), 3) == 3 * count
        assert one.table.tolist() == other.table.tolist() == [[0] * count, list(range(3, 3 + count))]
        assert [each.tobytes() for each in one.rows] == [each.tobytes() for each in other.rows]
