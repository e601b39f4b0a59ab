"""The user that called ``sudo``: scenarios and programs run with this user's rights."""

import os
import pwd


def caller() -> pwd.struct_passwd | None:
    """The user that called sudo; None: not run by sudo, or by root.

    Raises:
        KeyError: no such user on this machine.
    """
    number = os.environ.get("SUDO_UID", "")
    behind = os.geteuid() == 0 and number.isdecimal() and int(number) != 0
    return pwd.getpwuid(int(number)) if behind else None


def become(user: pwd.struct_passwd) -> None:
    """Give up root's rights: run this process and its children as this user."""
    os.initgroups(user.pw_name, user.pw_gid)
    os.setresgid(user.pw_gid, user.pw_gid, user.pw_gid)
    os.setresuid(user.pw_uid, user.pw_uid, user.pw_uid)
    os.environ.update(HOME=user.pw_dir, USER=user.pw_name, LOGNAME=user.pw_name)
