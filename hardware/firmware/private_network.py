"""Start firmware whose ports are fixed in a network of its own, so that several run at once and no other machine reaches them.

A program by itself, with nothing but the standard library: ``private_network.py DESCRIPTOR PORT COMMAND ...``. It enters a
new network namespace of Linux (as any user, in a new user namespace), binds a UDP socket to PORT of its loopback, hands that
over to the Unix socket DESCRIPTOR, and becomes COMMAND.
"""

import ctypes
import errno
import fcntl
import os
import socket
import struct
import sys

NEW_NET, NEW_USER = 0x40000000, 0x10000000  # CLONE_NEWNET, CLONE_NEWUSER (linux/sched.h)
SET_FLAGS, UP = 0x8914, 0x1  # SIOCSIFFLAGS, IFF_UP (linux/sockios.h, linux/if.h)
LOOPBACK = "127.0.0.1"


def enter() -> None:
    """Enter a new network, with its loopback up.

    Raises:
        OSError: this machine does not allow it.
    """
    unshare = ctypes.CDLL(None, use_errno=True).unshare
    if unshare(NEW_NET) and unshare(NEW_NET | NEW_USER):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        fcntl.ioctl(control, SET_FLAGS, struct.pack("16sH14x", b"lo", UP))


def main(descriptor: str, port: str, *command: str) -> None:
    """Hand a socket over and become the command."""
    try:
        enter()
    except OSError as error:
        sys.exit(f"this machine allows no network of its own for it ({error.strerror}): start one by hand")
    with socket.socket(fileno=int(descriptor)) as run, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind((LOOPBACK, int(port)))
        socket.send_fds(run, [b"."], [link.fileno()])
    try:
        os.execvp(command[0], command)  # noqa: S606  the scenario's command line
    except OSError as error:
        sys.exit(f"{command[0]} cannot be started: {errno.errorcode[error.errno or 0]}, {error.strerror}")


if __name__ == "__main__":
    main(*sys.argv[1:])
