"""What a page may send: the messages that viser's page sends of its own, as far as the control station has a use for them.

Not among them are uploads, and the request for a public tunnel to the page.
"""

from typing import Any

import msgspec

ALLOWED = frozenset(
    {
        "CommandTriggerMessage",
        "GuiButtonHoldMessage",
        "GuiFormDirtyMessage",
        "GuiFormSubmitMessage",
        "GuiUpdateMessage",
        "SceneNodeClickMessage",
        "SceneNodeDragMessage",
        "ScenePointerMessage",
        "TransformControlsDragEndMessage",
        "TransformControlsDragStartMessage",
        "TransformControlsUpdateMessage",
        "ViewerCameraMessage",
    }
)


def is_fit(message: Any) -> bool:
    """Whether a message may be handed on."""
    if not isinstance(message, bytes):
        return False
    try:
        content = msgspec.msgpack.decode(message)
    except (ValueError, TypeError, RecursionError, msgspec.DecodeError):
        return False
    if not isinstance(content, dict) or not isinstance(kind := content.get("type"), str) or kind not in ALLOWED:
        return False
    if kind == "GuiUpdateMessage":  # anything else of a control would be set as well
        updates = content.get("updates")
        return isinstance(updates, dict) and updates.keys() == {"value"}
    return True
