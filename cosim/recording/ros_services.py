"""Types of ROS 2 services in the store of message definitions, for their CDR bytes and hashes (REP 2011).

The hash of a service is that of a structure of its request, its response and their event (``service_msgs/msg/ServiceEventInfo``
with at most one of each), as ``rosidl`` defines it.
"""

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Fielddefs
from rosbags.typesys import get_types_from_msg

from vcmvsp.cosim.recording import ros_messages as ros

INFO = "service_msgs/msg/ServiceEventInfo"
_INFO = "uint8 event_type\nbuiltin_interfaces/Time stamp\nuint8[16] client_gid\nint64 sequence_number"


def register_message(name: str, definition: str) -> None:
    """Add a message ``package/msg/Name``, or a part of a service, to the store."""
    ros.store().register({name: get_types_from_msg(definition, "vcmvsp_msgs/msg/Parsed")["vcmvsp_msgs/msg/Parsed"]})


def register_service(name: str, request: str, response: str) -> None:
    """Add a service ``package/srv/Name`` to the store, with ``..._Request``, ``..._Response`` and ``..._Event``."""
    parsed = get_types_from_msg(_INFO, INFO)
    ros.store().fielddefs.update(parsed)  # rosbags has char[16], whose hash is another one: a char of ROS 2 is a uint8
    register_message(f"{name}_Request", request)
    register_message(f"{name}_Response", response)
    parts = {part: f"{name}_{part}" for part in ("Request", "Response", "Event")}
    event: Fielddefs = [("info", (Nodetype.NAME, INFO))]
    event += [(part.lower(), (Nodetype.SEQUENCE, ((Nodetype.NAME, parts[part]), 1))) for part in ("Request", "Response")]
    whole: Fielddefs = [(f"{part.lower()}_message", (Nodetype.NAME, kind)) for part, kind in parts.items()]
    ros.store().register({parts["Event"]: ([], event), name: ([], whole)})
