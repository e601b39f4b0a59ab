"""One colour per vehicle, the same in the recording's scene and in the figures.

The order is that of Okabe and Ito ("Color universal design", 2008), whose colours stay apart under every common form of
colour blindness; black leads and yellow, too pale on paper, is left out.
"""

OKABE_ITO = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")


def color_of(index: int) -> str:
    """Colour of vehicle ``index`` of a run as ``#rrggbb``; colours repeat after seven vehicles."""
    return OKABE_ITO[index % len(OKABE_ITO)]


def rgb_of(index: int) -> tuple[float, float, float]:
    """The same as red, green, blue in [0, 1]."""
    code = color_of(index)
    return int(code[1:3], 16) / 255, int(code[3:5], 16) / 255, int(code[5:7], 16) / 255
