"""What the parameters of a class mean, in its own words.

They have one home, the place where they are defined: the comment behind a field, or above it, which stands beside its type and
its default and is read with them; or, where there is no field, the ``Args`` section of the docstring, which wins.
"""

import ast
import inspect
import io
import re
import textwrap
import tokenize
from collections.abc import Callable, Mapping
from typing import Any


def meanings(target: Callable[..., object], *, joined: bool = False) -> Mapping[str, str]:
    """The meaning of each parameter of a class or function that has one, without a final period; those of base classes first.

    ::

        exponent: NonNegative = 3.0  # 2 in free space, about 3 among obstacles

    With ``joined``, what a class says of a parameter comes after what its base has said, instead of in its place.
    """
    found: dict[str, str] = {}
    for base in reversed(getattr(target, "__mro__", (target,))):
        own = _comments(base) if isinstance(base, type) and "__annotations__" in vars(base) else {}
        for name, said in {**own, **_arguments(base.__doc__ or "")}.items():
            words, before = said.strip().removesuffix("."), found.get(name, "") if joined else ""
            if words:
                found[name] = f"{before}; {words}" if before and before != words else words
    return found


def summary(target: object) -> str:
    """The first line of its docstring."""
    return (inspect.getdoc(target) or "").partition("\n")[0]


def _comments(target: type[Any]) -> dict[str, str]:
    """The comments of fields: those in the lines of the field, after those that fill the lines above it."""
    source = textwrap.dedent(inspect.getsource(target))
    lines = source.splitlines()
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}
    fields = next(node.body for node in ast.parse(source).body if isinstance(node, ast.ClassDef))
    found = {}
    for field in fields:
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            first, last = field.lineno, field.end_lineno or field.lineno
            while lines[first - 2].lstrip().startswith("#"):
                first -= 1
            found[field.target.id] = " ".join(comments[line] for line in range(first, last + 1) if line in comments)
    return found


def _arguments(docstring: str) -> dict[str, str]:
    """The entries of ``Args``: ``name: words`` or ``one, other: words``, and what is indented below."""
    section = re.search(r"^Args:\n(.*?)(?=^\S|\Z)", inspect.cleandoc(docstring), re.DOTALL | re.MULTILINE)
    if section is None:
        return {}
    entries = re.findall(r"^(\w[\w, ]*): (.*(?:\n .*)*)", textwrap.dedent(section[1]), re.MULTILINE)
    return {name: re.sub(r"\s+", " ", words) for names, words in entries for name in names.split(", ")}
