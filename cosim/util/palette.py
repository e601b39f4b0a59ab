"""Colours of vehicles, targets and commanders, the same in the recording's scene and in the figures.

The order is that of Okabe and Ito ("Color universal design", 2008), whose colours stay apart under every common form of
colour blindness; black comes first, and yellow, too pale on paper, is left out.
"""

OKABE_ITO = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")

TARGET = "#f0e442"  # Okabe and Ito's yellow, drawn with a dark edge
PROBABILITY = ("#ffffff", "#c9c4d6", "#5e2a84")
"""Colours of a probability map at 0, one half and 1: empty, unknown, target. Lightness alone tells them apart."""

COMMANDERS = {"search": "#56b4e9", "formation": "#0072b2", "track": "#009e73", "avoid1": "#e69f00", "avoid2": "#d55e00"}
"""Colours of a mission's commanders; others are grey."""


def color_of(index: int) -> str:
    """Colour of vehicle ``index`` of a run as ``#rrggbb``; colours repeat after seven vehicles."""
    return OKABE_ITO[index % len(OKABE_ITO)]


def rgb_of(index: int) -> tuple[float, float, float]:
    """Colour of vehicle ``index`` as red, green, blue in [0, 1]."""
    return rgb(color_of(index))


def rgb(code: str) -> tuple[float, float, float]:
    """A colour ``#rrggbb`` as red, green, blue in [0, 1]."""
    return int(code[1:3], 16) / 255, int(code[3:5], 16) / 255, int(code[5:7], 16) / 255
