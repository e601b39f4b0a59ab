"""The secret of a run that listens without certificates: programs of the user who started it find it in a file, others do not.

The file is ``PORT.secret`` in ``$XDG_RUNTIME_DIR/vcmvsp``, or in ``vcmvsp-UID`` of the folder for temporary files; others
cannot look into it. Zenoh compares secrets by a challenge: none passes over the link.
"""

import contextlib
import os
import secrets
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.transport.endpoints import parts
from vcmvsp.cosim.util.files import replacing

LONGEST = 200  # characters of a secret


@contextlib.contextmanager
def published(endpoint: str, secret: str) -> Iterator[None]:
    """While a run listens at an endpoint: let its user's programs find the secret.

    Raises:
        UsageError: the folder is somebody else's, or cannot be written to.
    """
    path = _path(endpoint)
    try:
        with replacing(path) as place:
            place.touch(0o600)
            place.write_text(secret)
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}; set XDG_RUNTIME_DIR to a folder of yours") from error
    try:
        yield
    finally:
        if found(endpoint) == secret:  # else another run listens there by now
            path.unlink(missing_ok=True)


def found(endpoint: str) -> str | None:
    """The secret of this user's run at an endpoint; None: there is none."""
    with contextlib.suppress(OSError, UnicodeDecodeError):
        return read(_path(endpoint))
    return None


def given(path: Path | None, *, insecure: bool) -> str | None:
    """What a program dials with: the secret in a file that its user names, none (empty), or what `found` finds (None).

    Raises:
        UsageError: the file cannot be read.
    """
    if path is None:
        return "" if insecure else None
    try:
        return read(path)
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"--secret {path}: cannot be read ({error})") from error


def read(path: Path) -> str:
    """The secret in a file."""
    with path.open("r") as file:
        return file.read(LONGEST).strip()


def made() -> str:
    """A new secret."""
    return secrets.token_hex(16)


def _path(endpoint: str) -> Path:
    own = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(own) / "vcmvsp" if own else Path(tempfile.gettempdir()) / f"vcmvsp-{os.getuid()}"
    with contextlib.suppress(FileExistsError):
        folder.mkdir(0o700)
    about = folder.lstat()
    if about.st_uid != os.getuid() or not stat.S_ISDIR(about.st_mode) or about.st_mode & 0o077:
        raise UsageError(f"{folder}: must be a folder that you alone can use (chmod 700); set XDG_RUNTIME_DIR to another")
    return folder / f"{parts(endpoint)[2]}.secret"
