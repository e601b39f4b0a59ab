"""Other machines for ssh: imitated by a script, or this machine behind a real SSH server."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.support import requirements

PLAYED = """\
#!/bin/sh
# What ssh does with its last argument, in a home of its own. The others are kept for whoever wants to see them.
printf '%s\\n' "$@" >"$FAR/ssh-was-told"
for command; do :; done
cd "$FAR" && HOME="$FAR" TMPDIR="$FAR" exec sh -c "$command"
"""
SSHD = """\
ListenAddress 127.0.0.1:{port}
HostKey {folder}/host
AuthorizedKeysFile {folder}/user.pub
PidFile none
StrictModes no
UsePAM no
PasswordAuthentication no
KbdInteractiveAuthentication no
"""
ASYNCSSH = """
import asyncio, sys, asyncssh
port, folder = int(sys.argv[1]), sys.argv[2]

async def serve(process):
    pipe = asyncio.subprocess.PIPE
    child = await asyncio.create_subprocess_shell(process.command, stdin=pipe, stdout=pipe, stderr=pipe)
    await process.redirect(stdin=child.stdin, stdout=child.stdout, stderr=child.stderr)
    process.exit(await child.wait())

async def main():
    await asyncssh.listen("127.0.0.1", port, server_host_keys=[folder + "/host"], authorized_client_keys=folder + "/user.pub",
                          process_factory=serve, encoding=None)
    await asyncio.Event().wait()

asyncio.run(main())
"""


class Machine(NamedTuple):
    """A machine that ssh reaches."""

    ssh: str  # for a file of hosts
    options: tuple[str, ...]
    environment: dict[str, str]  # environment of the caller of ssh
    server: subprocess.Popen[bytes] | None


def scripted_ssh(folder: Path) -> Machine:
    """A program called ssh that runs commands in ``folder``."""
    folder.mkdir()
    programs = folder.parent / "programs"
    programs.mkdir()
    (programs / "ssh").write_text(PLAYED)
    (programs / "ssh").chmod(0o755)
    return Machine("anna@far", (), {"PATH": f"{programs}:{os.environ['PATH']}", "FAR": str(folder)}, None)


def ssh_server(kind: str, folder: Path, port: int) -> Machine:
    """This machine behind ``sshd`` of OpenSSH or ``asyncssh`` of PyPI, at a port; the key is in ``folder``."""
    for each in ("ssh", "ssh-keygen"):
        requirements.program(each)
    folder.mkdir()
    for name in ("host", "user"):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(folder / name)], check=True, timeout=500)
    (folder / "config").write_text(SSHD.format(port=port, folder=folder))
    (folder / "known").write_text(f"[127.0.0.1]:{port} {(folder / 'host.pub').read_text()}")
    if kind == "asyncssh":
        command = [sys.executable, "-c", ASYNCSSH, str(port), str(folder)]
    else:
        command = [str(requirements.program("sshd")), "-D", "-e", "-f", str(folder / "config")]
    server = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    last = time.monotonic() + 30.0
    while time.monotonic() < last and server.poll() is None:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
            break
        except OSError:
            time.sleep(0.05)
    else:
        server.kill()
        server.wait()
        pytest.skip(f"{kind} does not start (as root, sshd wants /run/sshd, which .ci/debian-packages makes)")
    options = ("-F", "none", "-i", str(folder / "user"), "-o", "IdentitiesOnly=yes", "-p", str(port))
    return Machine("127.0.0.1", (*options, "-o", f"UserKnownHostsFile={folder / 'known'}"), {}, server)
