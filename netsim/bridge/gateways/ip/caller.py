"""The user behind ``sudo``: root's rights are for making interfaces, not for scenarios and programs."""

import os
import pwd


def caller() -> pwd.struct_passwd | None:
    """Who has called sudo; None: nobody has, or root itself.

    Raises:
        KeyError: this machine knows no such user.
    """
    number = os.environ.get("SUDO_UID", "")
    behind = os.geteuid() == 0 and number.isdecimal() and int(number) != 0
    return pwd.getpwuid(int(number)) if behind else None


def become(user: pwd.struct_passwd) -> None:
    """Have this process, and what it starts, be this user's for good."""
    os.initgroups(user.pw_name, user.pw_gid)
    os.setresgid(user.pw_gid, user.pw_gid, user.pw_gid)
    os.setresuid(user.pw_uid, user.pw_uid, user.pw_uid)
    os.environ.update(HOME=user.pw_dir, USER=user.pw_name, LOGNAME=user.pw_name)
