"""The numbers of commands, as far as clients use them. Sources: AmigoBot and Pioneer 2 manuals, tables of client commands."""

from enum import IntEnum


class Command(IntEnum):
    """Number of a command; the argument is an int in the unit of its comment unless it says otherwise."""

    PULSE = 0  # none: only restarts the watchdog
    OPEN = 1  # none or 1: start the information packets
    CLOSE = 2  # none or 1: stop, end the session
    ENABLE = 4  # 0/1: motors
    SETA = 5  # mm/s2, + acceleration, - deceleration
    SETV = 6  # mm/s, greatest speed of MOVE and VEL
    SETO = 7  # none: odometry to 0, 0, 0
    MOVE = 8  # mm, + forward
    ROTATE = 9  # deg/s, + counter-clockwise
    SETRV = 10  # deg/s, greatest yaw rate
    VEL = 11  # mm/s, + forward
    HEAD = 12  # deg, absolute
    DHEAD = 13  # deg, + counter-clockwise
    CONFIG = 18  # none or 1: ask for the configuration packet
    RVEL = 21  # deg/s, + counter-clockwise
    SETRA = 23  # deg/s2, + acceleration, - deceleration
    SONAR = 28  # 0/1
    STOP = 29  # none: decelerate to standstill
    VEL2 = 32  # low byte right wheel, high byte left wheel, signed, 20 mm/s each
    HOSTBAUD = 50  # 0-4: 9600, 19200, 38400, 57600, 115200
    ESTOP = 55  # none: stop at once


SYNC0, SYNC1, SYNC2 = 0, 1, 2  # before a session is open, these numbers shake hands
CONFIG_PACKET = 0x20  # first data byte of the configuration packet
BAUDS = (9600, 19200, 38400, 57600, 115200)  # baud rates by the argument of HOSTBAUD
