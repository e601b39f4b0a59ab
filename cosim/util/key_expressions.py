"""Key expressions: the topics of the run, with Zenoh's meaning of ``*`` (one chunk) and ``**`` (any number of chunks)."""


def matches(expression: str, key: str) -> bool:
    """Whether a key is in the set that a key expression stands for."""
    return expression == key or _match(expression.split("/"), key.split("/"))


def _match(pattern: list[str], chunks: list[str]) -> bool:
    if not pattern:
        return not chunks
    if pattern[0] == "**":
        return any(_match(pattern[1:], chunks[skip:]) for skip in range(len(chunks) + 1))
    return bool(chunks) and pattern[0] in ("*", chunks[0]) and _match(pattern[1:], chunks[1:])
